// What is kept of one robot: its last words, where it was, and its curves.
import type { DriveView, Robot, RobotLive } from '../api/schema';
import { Motion, type Shown } from '../map/motion';
import { doing, hasFault } from '../standstill';

/** Most points of a trail. */
export const TRAIL_POINTS = 200;
/** Distance between two points of a trail, metres. */
const TRAIL_STEP_M = 0.08;
/** Most places that wait until the robot is drawn at them. */
const AHEAD_MAX = 16;
/** How far back curves go, seconds. */
export const CURVE_SPAN_S = 300;
/** Most samples of curves: five minutes at 5 Hz. */
const CURVE_SAMPLES = 1_500;

/** One moment of the curves; what was not known is null. */
export interface Sample {
  /** Time of the page's monotonic clock, seconds. */
  at_s: number;
  crossTrack_m: number | null;
  speed_m_s: number | null;
  theta: number | null;
  thetaSd: number | null;
  thetaLoop: number | null;
  /** Shares of the rim's speed. */
  slipLeft: number | null;
  slipRight: number | null;
  isExcited: boolean;
}

/** A place of the trail that the robot is not drawn at yet. */
interface Ahead {
  at_ms: number;
  x_m: number;
  y_m: number;
}

export class Tracked {
  /** x and y in turn, metres, oldest first; up to where the robot is drawn. */
  trail: number[] = [];
  samples: Sample[] = [];

  readonly #motion = new Motion();
  #ahead: Ahead[] = [];
  /** How it looks beside its place. */
  #look = '';

  constructor(
    public robot: Robot,
    /** When the server said this, by this page's monotonic clock, milliseconds. */
    public receivedAt: number,
  ) {
    this.#note(0);
  }

  /**
   * Takes its newest words; true if it has to be drawn afresh. Samples for the curves are kept at least so
   * far apart, milliseconds.
   */
  update(robot: Robot, receivedAt: number, apartMs = 0): boolean {
    this.robot = robot;
    this.receivedAt = receivedAt;
    const before = this.#look;
    this.#note(apartMs);
    return this.#look !== before || this.shownAt(receivedAt)?.isMoving === true;
  }

  /** Takes its place from its drive socket, which says it more often; true if it is to be drawn. */
  seen(view: DriveView, receivedAt: number): boolean {
    this.#move(view, receivedAt, view.link);
    return this.shownAt(receivedAt)?.isMoving === true;
  }

  /** Where it is drawn at a time of the page's clock; null as long as its place is unknown. */
  shownAt(now: number): Shown | null {
    const shown = this.#motion.at(now);
    const due_ms = now - this.#motion.delay_ms;
    while (this.#ahead[0] && this.#ahead[0].at_ms <= due_ms) this.#settle();
    const pose = this.robot.live?.pose?.value;
    // Out of contact it is drawn where it was last, not where that would have taken it.
    if (shown && pose && this.robot.link === 'offline') return { pose, isMoving: false, isFrozen: false };
    return shown;
  }

  /** Age of what is shown, seconds; null if it was never heard. */
  ageS(now: number): number | null {
    const live = this.robot.live;
    if (!live) return null;
    return (live.state_age_ms + now - this.receivedAt) / 1000;
  }

  #note(apartMs: number): void {
    const { robot } = this;
    const { live } = robot;
    this.#look = JSON.stringify([
      robot.link,
      robot.name,
      robot.configuration,
      live?.safety.stop != null,
      hasFault(live),
      doing(live).isBad,
    ]);
    if (live) this.#move(live, this.receivedAt, robot.link);
    if (!live || robot.link !== 'online') return;
    const at_s = this.receivedAt / 1000;
    if ((at_s - (this.samples.at(-1)?.at_s ?? -Infinity)) * 1000 < apartMs) return;
    const friction = live.friction?.value;
    this.samples.push({
      at_s,
      crossTrack_m: live.mission?.cross_track_m ?? null,
      speed_m_s: live.twist?.value.linear_m_s ?? null,
      theta: friction?.theta_measured?.theta ?? null,
      thetaSd: friction?.theta_measured?.std_dev ?? null,
      thetaLoop: friction?.theta_loop ?? null,
      slipLeft: friction?.slip?.left_ratio ?? null,
      slipRight: friction?.slip?.right_ratio ?? null,
      isExcited: friction?.excited ?? false,
    });
    const old = this.samples.findIndex((sample) => sample.at_s > at_s - CURVE_SPAN_S);
    const over = Math.max(old, this.samples.length - CURVE_SAMPLES);
    if (over > 0) this.samples.splice(0, over);
  }

  #move({ pose, twist }: Pick<RobotLive | DriveView, 'pose' | 'twist'>, receivedAt: number, link: Robot['link']): void {
    if (!pose) return;
    const at_ms = receivedAt - pose.age_ms;
    this.#motion.push({ at_ms, pose: pose.value, twist: twist?.value ?? null });
    // Of one that is not heard nobody knows whether it drives on.
    if (link !== 'online') this.#motion.hold();
    if (this.robot.link !== 'online') return;
    const { x_m, y_m } = pose.value;
    this.#ahead.push({ at_ms, x_m, y_m });
    // A page that is not looked at draws nothing, and keeps no more for it.
    if (this.#ahead.length > AHEAD_MAX) this.#settle();
  }

  /** The oldest place that was ahead joins the trail. */
  #settle(): void {
    const place = this.#ahead.shift();
    if (!place) return;
    const { trail } = this;
    const dx = place.x_m - (trail.at(-2) ?? Infinity);
    const dy = place.y_m - (trail.at(-1) ?? Infinity);
    if (Math.hypot(dx, dy) < TRAIL_STEP_M) return;
    trail.push(place.x_m, place.y_m);
    if (trail.length > TRAIL_POINTS * 2) trail.splice(0, trail.length - TRAIL_POINTS * 2);
  }
}
