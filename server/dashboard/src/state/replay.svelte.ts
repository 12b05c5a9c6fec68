// A past mission that is looked at again: where its time line stands, and whether it runs.
import type { MissionDetail, PlannedPath } from '../api/schema';
import { Track } from '../map/replay';

/** How much faster than it was, so that a mission of minutes is seen in seconds. */
export const SPEEDS = [1, 4, 16] as const;

export class Replay {
  readonly mission: string;
  readonly track: Track | null;
  /** How far the robot may have been from the line that it reported, metres. */
  readonly tolerance_m: number;
  time_s = $state(0);
  isRunning = $state(false);
  speed = $state<number>(4);

  #frame = 0;

  constructor(
    detail: MissionDetail,
    plan: PlannedPath | null,
    /** The map shows another moment. */
    readonly moved: () => void,
  ) {
    this.mission = detail.id;
    const { points, times_s } = detail.driven ?? { points: [], times_s: undefined };
    this.tolerance_m = detail.driven?.tolerance_m ?? 0;
    this.track = Track.isTimed(points, times_s) ? new Track(points, times_s, plan?.points ?? []) : null;
    // The whole path is shown first.
    this.time_s = this.track?.to_s ?? 0;
  }

  seek(time_s: number): void {
    this.time_s = time_s;
    this.moved();
  }

  toggle(): void {
    if (this.isRunning) this.pause();
    else this.#run();
  }

  pause(): void {
    cancelAnimationFrame(this.#frame);
    this.isRunning = false;
  }

  #run(): void {
    const { track } = this;
    if (!track) return;
    if (this.time_s >= track.to_s) this.time_s = track.from_s;
    this.isRunning = true;
    let last = performance.now();
    const step = (now: number) => {
      if (!this.isRunning) return;
      const next = this.time_s + ((now - last) / 1000) * this.speed;
      last = now;
      this.seek(Math.min(next, track.to_s));
      if (next >= track.to_s) this.isRunning = false;
      else this.#frame = requestAnimationFrame(step);
    };
    this.#frame = requestAnimationFrame(step);
  }
}
