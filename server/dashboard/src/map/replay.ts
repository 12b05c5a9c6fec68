// A past mission on a time line: where the robot was at any moment, and how far from its path. Pure.
import type { PointM } from './camera';

/** Moments of the curve of errors. */
const SAMPLES = 240;

export interface Moment {
  at: PointM;
  /** Which way it went, counter-clockwise from the x axis; not which way it looked. */
  course_rad: number;
  /** The driven point at or before it. */
  index: number;
}

export class Track {
  /** Time of each sample of [`errors_m`], seconds. */
  readonly sampled_s: number[] = [];
  /** Distance from the planned path at each sample; empty where no path is known. */
  readonly errors_m: number[] = [];

  constructor(
    readonly points: readonly PointM[],
    readonly times_s: readonly number[],
    readonly planned: readonly PointM[],
  ) {
    if (planned.length === 0) return;
    for (let sample = 0; sample < SAMPLES; sample += 1) {
      const time_s = this.from_s + ((this.to_s - this.from_s) * sample) / (SAMPLES - 1);
      this.sampled_s.push(time_s);
      this.errors_m.push(distance(this.at(time_s).at, planned));
    }
  }

  /** Whether the robot has said when it was where. */
  static isTimed(points: readonly PointM[], times_s: readonly number[] | undefined): times_s is number[] {
    return times_s !== undefined && points.length > 1 && times_s.length === points.length;
  }

  get from_s(): number {
    return this.times_s[0] ?? 0;
  }

  get to_s(): number {
    return this.times_s.at(-1) ?? 0;
  }

  at(time_s: number): Moment {
    let [low, high] = [0, this.times_s.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if ((this.times_s[middle] ?? 0) <= time_s) low = middle;
      else high = middle - 1;
    }
    const index = Math.min(low, Math.max(0, this.points.length - 2));
    const here = this.points[index] ?? { x_m: 0, y_m: 0 };
    const next = this.points[index + 1] ?? here;
    const [begin, end] = [this.times_s[index] ?? 0, this.times_s[index + 1] ?? 0];
    const share = end > begin ? Math.min(1, Math.max(0, (time_s - begin) / (end - begin))) : 0;
    return {
      at: { x_m: here.x_m + share * (next.x_m - here.x_m), y_m: here.y_m + share * (next.y_m - here.y_m) },
      course_rad: this.#courseAt(index),
      index,
    };
  }

  /** Which way it went from a point; while it stood, the way that it came, or else the way it goes on. */
  #courseAt(index: number): number {
    const leaves = (at: number) => {
      const [here, next] = [this.points[at], this.points[at + 1]];
      const [dx, dy] = here && next ? [next.x_m - here.x_m, next.y_m - here.y_m] : [0, 0];
      return dx === 0 && dy === 0 ? null : Math.atan2(dy, dx);
    };
    for (let at = index; at >= 0; at -= 1) {
      const course = leaves(at);
      if (course !== null) return course;
    }
    for (let at = index + 1; at < this.points.length; at += 1) {
      const course = leaves(at);
      if (course !== null) return course;
    }
    return 0;
  }

  /** Distance from the planned path at a moment, metres; null where no path is known. */
  errorAt(time_s: number): number | null {
    return this.planned.length === 0 ? null : distance(this.at(time_s).at, this.planned);
  }
}

/** Distance of a place from a line through points, metres. */
export function distance(place: PointM, line: readonly PointM[]): number {
  let least = Infinity;
  for (let index = 0; index < line.length; index += 1) {
    const from = line[index];
    const to = line[Math.min(index + 1, line.length - 1)];
    if (!from || !to) continue;
    const [dx, dy] = [to.x_m - from.x_m, to.y_m - from.y_m];
    const length = dx * dx + dy * dy;
    const along = length > 0 ? ((place.x_m - from.x_m) * dx + (place.y_m - from.y_m) * dy) / length : 0;
    const share = Math.min(1, Math.max(0, along));
    least = Math.min(least, Math.hypot(place.x_m - from.x_m - share * dx, place.y_m - from.y_m - share * dy));
  }
  return least;
}
