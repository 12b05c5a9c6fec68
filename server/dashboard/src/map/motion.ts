// Motion of one robot between the states that it reports, so that the map draws it smoothly. Pure.
//
// A robot is drawn late, by about one period of its states, so that it lies between two known ones:
// a cubic Hermite curve through both, with their twists as tangents. When the next state is late,
// the last twist carries it on along an arc for a bounded time; then it stands, and `isFrozen` says
// that it is no longer known where it is. Where states come seldom, that time is used in each
// period, so that what is drawn is less late; what the twist got wrong is made good smoothly.
import type { AgedTwist, Pose } from '../api/schema';

type Twist = AgedTwist['value'];

export interface State {
  /** When it was measured, by this page's monotonic clock, milliseconds. */
  at_ms: number;
  pose: Pose;
  twist: Twist | null;
}

export interface Shown {
  pose: Pose;
  /** A later frame differs from this one even if nothing more is heard. */
  isMoving: boolean;
  /** It moved when it was heard last, and that is too long ago. */
  isFrozen: boolean;
}

/** How far the last twist may carry a robot, milliseconds. */
export const EXTRAPOLATION_MAX_MS = 500;
/** Delay of what is drawn, in state periods: a little more than one, so that a late state does no harm. */
const DELAY_PERIODS = 1.15;
/** How much of a long period the twist bridges, milliseconds: less than it may, since states come unevenly. */
const BRIDGED_MS = 250;
/** Period that is assumed until states have shown theirs, milliseconds: that of the stream of events. */
const PERIOD_MS = 1_000;
const PERIOD_MIN_MS = 50;
const PERIOD_MAX_MS = 1_200;
/** Shares of a new period in their running mean: a longer one counts soon, or robots would halt. */
const LONGER_GAIN = 0.5;
const SHORTER_GAIN = 0.2;
/** How long the error of a prediction takes to be made good, milliseconds. */
const BLEND_MS = 250;
/** States nearer to each other in time are one that was heard twice, milliseconds. */
const SAME_MS = 15;
/** Between states farther apart in time nothing is known of the path, milliseconds. */
const GAP_MAX_MS = 2_000;
/** A step that is longer than what the speed explains by this is a jump, metres. */
export const JUMP_M = 0.5;
/** Below these a robot stands. */
const STANDING_M_S = 0.02;
const STANDING_RAD_S = 0.02;
/** A robot that stands is drawn afresh only beyond these: its localisation is never quite still. */
const REST_M = 0.02;
const REST_RAD = 0.02;
/** States that are kept. */
const STATES_MAX = 16;

/** By how much what was drawn differs from what is known since. */
interface Misplaced {
  at_ms: number;
  x_m: number;
  y_m: number;
  heading_rad: number;
}

export class Motion {
  readonly #states: State[] = [];
  #period_ms = PERIOD_MS;
  /** What is drawn never goes back in time. */
  #drawn_ms = -Infinity;
  #error: Misplaced | null = null;

  /** How late robots are drawn, milliseconds. */
  get delay_ms(): number {
    const delay_ms = DELAY_PERIODS * this.#period_ms;
    return Math.max(Math.min(delay_ms, BRIDGED_MS), delay_ms - BRIDGED_MS);
  }

  push(state: State): void {
    const last = this.#states.at(-1);
    if (!last) {
      this.#states.push(state);
      return;
    }
    const passed_ms = state.at_ms - last.at_ms;
    if (passed_ms < SAME_MS) return;
    // A robot that stands says so more seldom, which tells nothing of its period on the move.
    if (passed_ms <= GAP_MAX_MS && moves(state.twist) && moves(last.twist)) {
      const gain = passed_ms > this.#period_ms ? LONGER_GAIN : SHORTER_GAIN;
      const period_ms = this.#period_ms + gain * (passed_ms - this.#period_ms);
      this.#period_ms = Math.min(PERIOD_MAX_MS, Math.max(PERIOD_MIN_MS, period_ms));
    }
    const before = this.#known(this.#drawn_ms);
    const rests = !moves(state.twist) && !moves(last.twist) && isNear(state.pose, last.pose);
    this.#states.push(rests ? { ...state, pose: last.pose } : state);
    if (this.#states.length > STATES_MAX) this.#states.shift();
    if (before) this.#note(this.#corrected(before).pose);
  }

  /** Where the robot is drawn at a time of the page's clock; null before its first state. */
  at(now_ms: number): Shown | null {
    this.#drawn_ms = Math.max(this.#drawn_ms, now_ms - this.delay_ms);
    const states = this.#states;
    while (states.length > 1 && (states[1]?.at_ms ?? Infinity) <= this.#drawn_ms) states.shift();
    const known = this.#known(this.#drawn_ms);
    return known && this.#corrected(known);
  }

  /** Where its states say that it was; null before the first. */
  #known(at_ms: number): Shown | null {
    const states = this.#states;
    const index = Math.max(0, states.findLastIndex((state) => state.at_ms <= at_ms));
    const [from, to] = [states[index], states[index + 1]];
    if (!from) return null;
    const isMoving = states.some((state) => state.pose !== from.pose) || moves(states.at(-1)?.twist);
    if (at_ms <= from.at_ms) return { pose: from.pose, isMoving, isFrozen: false };
    if (!to) return carried(from, at_ms);
    if (isJump(from, to)) return { ...carried(from, at_ms), isMoving };
    return { pose: from.pose === to.pose ? from.pose : between(from, to, at_ms), isMoving, isFrozen: false };
  }

  /** Notes that a robot was drawn somewhere, while its states say now that it was somewhere else. */
  #note(drawn: Pose): void {
    this.#error = null;
    const known = this.#known(this.#drawn_ms)?.pose;
    if (!known || known === drawn || distance(known, drawn) > JUMP_M) return;
    this.#error = {
      at_ms: this.#drawn_ms,
      x_m: drawn.x_m - known.x_m,
      y_m: drawn.y_m - known.y_m,
      heading_rad: turnOf(known.heading_rad, drawn.heading_rad),
    };
  }

  #corrected(known: Shown): Shown {
    const error = this.#error;
    const left = error ? 1 - (this.#drawn_ms - error.at_ms) / BLEND_MS : 0;
    if (!error || left <= 0) return known;
    const { x_m, y_m, heading_rad } = known.pose;
    return {
      ...known,
      pose: {
        x_m: x_m + left * error.x_m,
        y_m: y_m + left * error.y_m,
        heading_rad: heading_rad + left * error.heading_rad,
      },
      isMoving: true,
    };
  }
}

/** Smallest turn from one heading to another, radians. */
export function turnOf(from_rad: number, to_rad: number): number {
  const turn = (to_rad - from_rad) % (2 * Math.PI);
  if (turn > Math.PI) return turn - 2 * Math.PI;
  return turn < -Math.PI ? turn + 2 * Math.PI : turn;
}

function moves(twist: Twist | null | undefined): boolean {
  if (!twist) return false;
  return Math.abs(twist.linear_m_s) > STANDING_M_S || Math.abs(twist.angular_rad_s) > STANDING_RAD_S;
}

function isNear(a: Pose, b: Pose): boolean {
  return distance(a, b) < REST_M && Math.abs(turnOf(a.heading_rad, b.heading_rad)) < REST_RAD;
}

function distance(a: Pose, b: Pose): number {
  return Math.hypot(a.x_m - b.x_m, a.y_m - b.y_m);
}

/** Nobody knows what lies between: too long ago, or farther than its speed takes it. */
function isJump(from: State, to: State): boolean {
  const passed_s = (to.at_ms - from.at_ms) / 1000;
  if (passed_s * 1000 > GAP_MAX_MS) return true;
  const speed_m_s = Math.max(Math.abs(from.twist?.linear_m_s ?? 0), Math.abs(to.twist?.linear_m_s ?? 0));
  return distance(from.pose, to.pose) > JUMP_M + speed_m_s * passed_s;
}

/** Between two states; straight where their twists are unknown. */
function between(from: State, to: State, at_ms: number): Pose {
  const passed_s = (to.at_ms - from.at_ms) / 1000;
  const share = (at_ms - from.at_ms) / (to.at_ms - from.at_ms);
  const rest = 1 - share;
  const heading_rad = from.pose.heading_rad + share * turnOf(from.pose.heading_rad, to.pose.heading_rad);
  const [begin, end] = [tangent(from), tangent(to)];
  // Hermite's basis: of both places, and of both tangents.
  const [p, q] = [rest * rest * (1 + 2 * share), share * share * (1 + 2 * rest)];
  const [u, v] = [share * rest * rest, -share * share * rest];
  const mix = (a: number, b: number, da: number | undefined, db: number | undefined) =>
    da === undefined || db === undefined ? rest * a + share * b : p * a + q * b + passed_s * (u * da + v * db);
  return {
    x_m: mix(from.pose.x_m, to.pose.x_m, begin?.x_m, end?.x_m),
    y_m: mix(from.pose.y_m, to.pose.y_m, begin?.y_m, end?.y_m),
    heading_rad,
  };
}

/** Velocity in the site's frame, metres per second; null where it is unknown. */
function tangent({ pose, twist }: State): { x_m: number; y_m: number } | null {
  if (!twist) return null;
  return { x_m: twist.linear_m_s * Math.cos(pose.heading_rad), y_m: twist.linear_m_s * Math.sin(pose.heading_rad) };
}

/** A state carried on by its twist along an arc, for a bounded time. */
function carried({ at_ms, pose, twist }: State, now_ms: number): Shown {
  if (!twist || !moves(twist)) return { pose, isMoving: false, isFrozen: false };
  const passed_ms = now_ms - at_ms;
  const isFrozen = passed_ms >= EXTRAPOLATION_MAX_MS;
  const time_s = Math.min(passed_ms, EXTRAPOLATION_MAX_MS) / 1000;
  const turn_rad = twist.angular_rad_s * time_s;
  // The chord of the arc: its length over the driven one, and its direction half-way round.
  const half_rad = turn_rad / 2;
  const chord_m = twist.linear_m_s * time_s * (Math.abs(half_rad) > 1e-6 ? Math.sin(half_rad) / half_rad : 1);
  return {
    pose: {
      x_m: pose.x_m + chord_m * Math.cos(pose.heading_rad + half_rad),
      y_m: pose.y_m + chord_m * Math.sin(pose.heading_rad + half_rad),
      heading_rad: pose.heading_rad + turn_rad,
    },
    isMoving: !isFrozen,
    isFrozen,
  };
}
