// Motion of one robot between the states that it reports, so that the map draws it smoothly. Pure.
//
// A robot is drawn a little late. Where states come often, that is about one period of them, so that it
// lies between two known ones: a cubic Hermite curve through both, with their twists as tangents. Where
// they come seldom, the twist of the last one carries the robot on along an arc, for a bounded time;
// then it stands, and `isFrozen` says that it is no longer known where it is. What the twist predicted
// wrong is made good smoothly.
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

/**
 * How far the last twist may carry a robot, milliseconds: a period of the stream of events, with the age of
 * the state in it, less the delay.
 */
export const EXTRAPOLATION_MAX_MS = 1_200;
/** Delay of what is drawn, in state periods: a little more than one, so that a late state does no harm. */
const DELAY_PERIODS = 1.15;
/** Longest delay of what is drawn, however seldom states come, milliseconds. */
export const DELAY_MAX_MS = 250;
/** Period that is assumed until states have shown theirs, milliseconds: that of the stream of events. */
const PERIOD_MS = 1_000;
const PERIOD_MIN_MS = 50;
const PERIOD_MAX_MS = 1_200;
/** Shares of a new period in their running mean: a longer one counts soon, or robots would halt. */
const LONGER_GAIN = 0.5;
const SHORTER_GAIN = 0.2;
/** How long the error of a prediction takes to be made good, milliseconds. */
const BLEND_MS = 500;
/** A robot that slows down by at least this is carried on as if it went on doing so, m/s². */
const BRAKES_M_S2 = 0.25;
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
  /** From when on its last state carries the robot no farther, if that state is not newer. */
  #held_ms = -Infinity;
  /** How soon the robot will stand, by its last two states, seconds. */
  #stands_s = Infinity;

  /** How late robots are drawn, milliseconds. */
  get delay_ms(): number {
    return Math.min(DELAY_PERIODS * this.#period_ms, DELAY_MAX_MS);
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
    this.#stands_s = standsInS(last, state);
    if (before) this.#note(this.#corrected(before).pose);
  }

  /** Nobody knows whether it drives on: until its next state it stands where it is drawn. */
  hold(): void {
    const last_ms = this.#states.at(-1)?.at_ms ?? Infinity;
    if (this.#held_ms < last_ms) this.#held_ms = Math.max(this.#drawn_ms, last_ms);
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
    if (!to) return this.#carried(from, at_ms, this.#stands_s);
    if (isJump(from, to)) return { ...this.#carried(from, at_ms, Infinity), isMoving };
    return { pose: from.pose === to.pose ? from.pose : between(from, to, at_ms), isMoving, isFrozen: false };
  }

  /** Where a state takes the robot by itself, for a bounded time; slower and slower if it is about to stand. */
  #carried({ at_ms: from_ms, pose, twist }: State, at_ms: number, stands_s: number): Shown {
    if (!twist || !moves(twist)) return { pose, isMoving: false, isFrozen: false };
    const held_ms = this.#held_ms < from_ms ? Infinity : this.#held_ms;
    const end_ms = Math.min(from_ms + EXTRAPOLATION_MAX_MS, held_ms);
    const isFrozen = at_ms >= end_ms;
    const time_s = Math.min((Math.min(at_ms, end_ms) - from_ms) / 1000, stands_s);
    return {
      pose: arc(pose, twist, time_s - (time_s * time_s) / (2 * stands_s)),
      isMoving: !isFrozen,
      isFrozen,
    };
  }

  /** Notes that a robot was drawn somewhere, while its states say now that it was somewhere else. */
  #note(drawn: Pose): void {
    this.#error = null;
    const known = this.#known(this.#drawn_ms)?.pose;
    if (!known || known === drawn) return;
    // As far as the twist may have carried it wrongly; beyond that it is a jump.
    const speed_m_s = Math.max(...this.#states.map(({ twist }) => Math.abs(twist?.linear_m_s ?? 0)));
    if (distance(known, drawn) > JUMP_M + (speed_m_s * EXTRAPOLATION_MAX_MS) / 1000) return;
    this.#error = {
      at_ms: this.#drawn_ms,
      x_m: drawn.x_m - known.x_m,
      y_m: drawn.y_m - known.y_m,
      heading_rad: turnOf(known.heading_rad, drawn.heading_rad),
    };
  }

  #corrected(known: Shown): Shown {
    const error = this.#error;
    const passed = error ? (this.#drawn_ms - error.at_ms) / BLEND_MS : 1;
    if (!error || passed >= 1) return known;
    // Without a step in the speed either.
    const left = (1 - passed) * (1 - passed) * (1 + 2 * passed);
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

/** A state carried on along an arc: by its twist, for so long. */
function arc(pose: Pose, twist: Twist, time_s: number): Pose {
  const turn_rad = twist.angular_rad_s * time_s;
  // The chord of the arc: its length over the driven one, and its direction half-way round.
  const half_rad = turn_rad / 2;
  const chord_m = twist.linear_m_s * time_s * (Math.abs(half_rad) > 1e-6 ? Math.sin(half_rad) / half_rad : 1);
  return {
    x_m: pose.x_m + chord_m * Math.cos(pose.heading_rad + half_rad),
    y_m: pose.y_m + chord_m * Math.sin(pose.heading_rad + half_rad),
    heading_rad: pose.heading_rad + turn_rad,
  };
}

/** How soon a robot that slows down will stand, seconds; infinite for one that does not. */
function standsInS(before: State, { at_ms, twist }: State): number {
  if (!before.twist || !twist) return Infinity;
  const [was_m_s, is_m_s] = [Math.abs(before.twist.linear_m_s), Math.abs(twist.linear_m_s)];
  const slows_m_s2 = ((was_m_s - is_m_s) * 1000) / (at_ms - before.at_ms);
  return slows_m_s2 < BRAKES_M_S2 ? Infinity : is_m_s / slows_m_s2;
}
