// What is kept of one robot: its last words, where it was, and its curves.
import type { Robot } from '../api/schema';

/** Most points of a trail. */
export const TRAIL_POINTS = 200;
/** Distance between two points of a trail, metres. */
const TRAIL_STEP_M = 0.08;
/** How far back curves go, seconds. */
export const CURVE_SPAN_S = 300;
/** Most samples of curves: five minutes at 5 Hz. */
const CURVE_SAMPLES = 1_500;

/** One moment of the curves; what was not known is null. */
export interface Sample {
  /** Wall time, seconds. */
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

export class Tracked {
  /** x and y in turn, metres, oldest first. */
  trail: number[] = [];
  samples: Sample[] = [];

  constructor(
    public robot: Robot,
    /** When the server said this, by this page's monotonic clock, milliseconds. */
    public receivedAt: number,
  ) {
    this.#note(0);
  }

  /** Takes a newer state; samples for the curves are kept at least so far apart, milliseconds. */
  update(robot: Robot, receivedAt: number, apartMs = 0): void {
    this.robot = robot;
    this.receivedAt = receivedAt;
    this.#note(apartMs);
  }

  /** Age of what is shown, seconds; null if it was never heard. */
  ageS(now: number): number | null {
    const live = this.robot.live;
    if (!live) return null;
    return (live.heard_age_ms + now - this.receivedAt) / 1000;
  }

  #note(apartMs: number): void {
    const live = this.robot.live;
    if (!live || this.robot.link !== 'online') return;
    const pose = live.pose?.value;
    if (pose) {
      const { trail } = this;
      const dx = pose.x_m - (trail.at(-2) ?? Infinity);
      const dy = pose.y_m - (trail.at(-1) ?? Infinity);
      if (!(Math.hypot(dx, dy) < TRAIL_STEP_M)) {
        trail.push(pose.x_m, pose.y_m);
        if (trail.length > TRAIL_POINTS * 2) trail.splice(0, trail.length - TRAIL_POINTS * 2);
      }
    }
    const at_s = Date.now() / 1000;
    if ((at_s - (this.samples.at(-1)?.at_s ?? 0)) * 1000 < apartMs) return;
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
}
