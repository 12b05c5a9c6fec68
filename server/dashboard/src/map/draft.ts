// What is being drawn: a circle, waypoints or a terrain's outline, with undo. Pure.
import type { PointM } from './camera';

export type DraftKind = 'circle' | 'waypoints' | 'terrain';

/** Most steps that can be taken back. */
const UNDO_MAX = 100;
/** Smallest circle, metres, as the API has it. */
export const RADIUS_MIN_M = 0.05;
/** How far from the origin a coordinate may be, metres, as the API has it. */
export const COORDINATE_MAX_M = 1e6;

interface Shape {
  center: PointM | null;
  radius_m: number;
  points: PointM[];
}

export class Draft implements Shape {
  kind: DraftKind;
  center: PointM | null = null;
  radius_m = 2;
  points: PointM[] = [];
  #past: Shape[] = [];

  constructor(kind: DraftKind, points: PointM[] = []) {
    this.kind = kind;
    this.points = points.map(({ x_m, y_m }) => ({ x_m, y_m }));
  }

  get canUndo(): boolean {
    return this.#past.length > 0;
  }

  get isEmpty(): boolean {
    return this.kind === 'circle' ? this.center === null : this.points.length === 0;
  }

  /** Enough to be a path or an outline. */
  get isWhole(): boolean {
    if (this.flaw) return false;
    if (this.kind === 'circle') return this.center !== null;
    return this.points.length >= (this.kind === 'terrain' ? 3 : 2);
  }

  /** What was typed and is nothing to draw; the number of a point, from 1. */
  get flaw(): 'center' | 'radius' | number | null {
    if (this.kind === 'circle') {
      if (this.center && !isPlace(this.center)) return 'center';
      return this.radius_m >= RADIUS_MIN_M ? null : 'radius';
    }
    const wrong = this.points.findIndex((point) => !isPlace(point));
    return wrong < 0 ? null : wrong + 1;
  }

  /** Keeps the present shape, so that what follows can be taken back in one step. */
  mark(): void {
    this.#past.push(this.#shape());
    if (this.#past.length > UNDO_MAX) this.#past.shift();
  }

  add(point: PointM): void {
    this.mark();
    this.points.push(rounded(point));
  }

  /** Moves a point without a mark: a drag marks once, at its begin. */
  move(index: number, point: PointM): void {
    if (index in this.points) this.points[index] = rounded(point);
  }

  /** A point out of numbers, as exactly as they were typed. */
  typePoint(index: number, point: PointM): void {
    if (index in this.points) this.points[index] = { ...point };
  }

  remove(index: number): void {
    if (!(index in this.points)) return;
    this.mark();
    this.points.splice(index, 1);
  }

  /** A circle out of numbers, also of such as are none: what was typed is kept, and said to be wrong. */
  typeCircle(center: PointM, radius_m: number): void {
    this.center = { ...center };
    this.radius_m = radius_m;
  }

  setCircle(center: PointM, radius_m: number): void {
    this.center = rounded(center);
    this.radius_m = Math.max(RADIUS_MIN_M, Math.round(radius_m * 100) / 100 || RADIUS_MIN_M);
  }

  clear(): void {
    if (this.isEmpty) return;
    this.mark();
    this.center = null;
    this.points = [];
  }

  undo(): void {
    const past = this.#past.pop();
    if (!past) return;
    this.center = past.center;
    this.radius_m = past.radius_m;
    this.points = past.points;
  }

  /** The point nearest to a place, if it is within reach. */
  nearest(place: PointM, reach_m: number): number | null {
    let best: number | null = null;
    let least = reach_m;
    this.points.forEach((point, index) => {
      const distance = Math.hypot(point.x_m - place.x_m, point.y_m - place.y_m);
      if (distance <= least) {
        best = index;
        least = distance;
      }
    });
    return best;
  }

  #shape(): Shape {
    return {
      center: this.center && { ...this.center },
      radius_m: this.radius_m,
      points: this.points.map((point) => ({ ...point })),
    };
  }
}

function isPlace({ x_m, y_m }: PointM): boolean {
  return Number.isFinite(x_m) && Number.isFinite(y_m);
}

/** To the centimetre: nobody points finer. */
function rounded({ x_m, y_m }: PointM): PointM {
  return { x_m: Math.round(x_m * 100) / 100, y_m: Math.round(y_m * 100) / 100 };
}
