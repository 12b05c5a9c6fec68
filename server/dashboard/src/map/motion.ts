// Motion of one robot between the states that it reports, so that the map draws it smoothly. Pure.
//
// A robot is drawn about one state period late, between two states that are known: by linear
// interpolation. When the next state is late, the last twist carries it on for a bounded time; then
// it stands, and `isFrozen` says that it is no longer known where it is.
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
/** Period that is assumed until states have shown theirs, milliseconds. */
const PERIOD_MS = 200;
const PERIOD_MIN_MS = 50;
const PERIOD_MAX_MS = 500;
/** Share of a new period in their running mean. */
const PERIOD_GAIN = 0.2;
/** States nearer to each other in time are one that was heard twice, milliseconds. */
const SAME_MS = 15;
/** Between states farther apart in time nothing is known of the path, milliseconds. */
const GAP_MAX_MS = 1_000;
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

export class Motion {
  readonly #states: State[] = [];
  #period_ms = PERIOD_MS;
  /** What is drawn never goes back in time. */
  #drawn_ms = -Infinity;

  /** How late robots are drawn, milliseconds. */
  get delay_ms(): number {
    return DELAY_PERIODS * this.#period_ms;
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
      const period_ms = this.#period_ms + PERIOD_GAIN * (passed_ms - this.#period_ms);
      this.#period_ms = Math.min(PERIOD_MAX_MS, Math.max(PERIOD_MIN_MS, period_ms));
    }
    const rests = !moves(state.twist) && !moves(last.twist) && isNear(state.pose, last.pose);
    this.#states.push(rests ? { ...state, pose: last.pose } : state);
    if (this.#states.length > STATES_MAX) this.#states.shift();
  }

  /** Where the robot is drawn at a time of the page's clock; null before its first state. */
  at(now_ms: number): Shown | null {
    this.#drawn_ms = Math.max(this.#drawn_ms, now_ms - this.delay_ms);
    const at_ms = this.#drawn_ms;
    const states = this.#states;
    while (states.length > 1 && (states[1]?.at_ms ?? Infinity) <= at_ms) states.shift();
    const [from, to] = states;
    if (!from) return null;
    const isMoving = states.some((state) => state.pose !== from.pose) || moves(states.at(-1)?.twist);
    if (at_ms <= from.at_ms) return { pose: from.pose, isMoving, isFrozen: false };
    if (!to) return carried(from, at_ms);
    if (isJump(from, to)) return { ...carried(from, at_ms), isMoving };
    const share = (at_ms - from.at_ms) / (to.at_ms - from.at_ms);
    return { pose: between(from.pose, to.pose, share), isMoving, isFrozen: false };
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

function between(from: Pose, to: Pose, share: number): Pose {
  return {
    x_m: from.x_m + share * (to.x_m - from.x_m),
    y_m: from.y_m + share * (to.y_m - from.y_m),
    heading_rad: from.heading_rad + share * turnOf(from.heading_rad, to.heading_rad),
  };
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
