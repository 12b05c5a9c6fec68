// Between metres of the site (y up) and pixels of the canvas (y down).

export interface PointM {
  x_m: number;
  y_m: number;
}

export interface PointPx {
  x: number;
  y: number;
}

/** A rectangle of the canvas, pixels. */
export interface RectPx {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

export interface Bounds {
  xMin: number;
  yMin: number;
  xMax: number;
  yMax: number;
}

/** Least and most pixels per metre. */
export const SCALE_MIN = 0.01;
export const SCALE_MAX = 500;
/** Pixels that stay free around what is fitted. */
const MARGIN_PX = 36;
/** Least width that a fit shows, metres. */
const FIT_MIN_M = 4;
/** Least side of a part of the canvas that is fitted into, pixels: a smaller one shows nothing. */
const FREE_MIN_PX = 160;

export class Camera {
  /** What stands in the middle of the canvas. */
  center: PointM = { x_m: 0, y_m: 0 };
  /** Pixels per metre. */
  scale = 20;
  width = 1;
  height = 1;

  toPx(point: PointM): PointPx {
    return {
      x: this.width / 2 + (point.x_m - this.center.x_m) * this.scale,
      y: this.height / 2 - (point.y_m - this.center.y_m) * this.scale,
    };
  }

  toM(point: PointPx): PointM {
    return {
      x_m: this.center.x_m + (point.x - this.width / 2) / this.scale,
      y_m: this.center.y_m - (point.y - this.height / 2) / this.scale,
    };
  }

  pan(dx: number, dy: number): void {
    this.center = { x_m: this.center.x_m - dx / this.scale, y_m: this.center.y_m + dy / this.scale };
  }

  /** Zooms so that what is under `at` stays there. */
  zoom(factor: number, at: PointPx = { x: this.width / 2, y: this.height / 2 }): void {
    const before = this.toM(at);
    this.scale = Math.min(SCALE_MAX, Math.max(SCALE_MIN, this.scale * factor));
    const after = this.toM(at);
    this.center = {
      x_m: this.center.x_m + before.x_m - after.x_m,
      y_m: this.center.y_m + before.y_m - after.y_m,
    };
  }

  /** Shows everything within bounds, as large as it can be beside what covers the canvas. */
  fit(bounds: Bounds, covered: readonly RectPx[] = []): void {
    const width = Math.max(bounds.xMax - bounds.xMin, FIT_MIN_M);
    const height = Math.max(bounds.yMax - bounds.yMin, FIT_MIN_M);
    const scaleIn = ({ left, top, right, bottom }: RectPx) =>
      Math.min(Math.max(1, right - left - 2 * MARGIN_PX) / width, Math.max(1, bottom - top - 2 * MARGIN_PX) / height);
    const free = this.#free(covered, scaleIn);
    this.scale = Math.min(SCALE_MAX, Math.max(SCALE_MIN, scaleIn(free)));
    this.#put({ x_m: (bounds.xMin + bounds.xMax) / 2, y_m: (bounds.yMin + bounds.yMax) / 2 }, free);
  }

  /** Shows a place in the middle of the largest part of the canvas that nothing covers. */
  showPlace(place: PointM, scale: number, covered: readonly RectPx[] = []): void {
    this.scale = Math.min(SCALE_MAX, Math.max(SCALE_MIN, scale));
    this.#put(place, this.#free(covered, ({ left, top, right, bottom }) => (right - left) * (bottom - top)));
  }

  /** Moves so that a place stands in the middle of a rectangle. */
  #put(place: PointM, { left, top, right, bottom }: RectPx): void {
    this.center = {
      x_m: place.x_m - ((left + right) / 2 - this.width / 2) / this.scale,
      y_m: place.y_m + ((top + bottom) / 2 - this.height / 2) / this.scale,
    };
  }

  /** The best rectangle that nothing covers; the whole canvas if nothing of some size is left. */
  #free(covered: readonly RectPx[], worth: (rectangle: RectPx) => number): RectPx {
    const whole = { left: 0, top: 0, right: this.width, bottom: this.height };
    let best: RectPx | null = null;
    for (const left of [0, ...covered.map((rectangle) => rectangle.right)]) {
      for (const right of [this.width, ...covered.map((rectangle) => rectangle.left)]) {
        if (right - left < FREE_MIN_PX) continue;
        for (const top of [0, ...covered.map((rectangle) => rectangle.bottom)]) {
          for (const bottom of [this.height, ...covered.map((rectangle) => rectangle.top)]) {
            const one = { left, top, right, bottom };
            if (bottom - top < FREE_MIN_PX || covered.some((other) => overlap(one, other))) continue;
            if (!best || worth(one) > worth(best)) best = one;
          }
        }
      }
    }
    return best ?? whole;
  }

  /** What can be seen. */
  get bounds(): Bounds {
    const low = this.toM({ x: 0, y: this.height });
    const high = this.toM({ x: this.width, y: 0 });
    return { xMin: low.x_m, yMin: low.y_m, xMax: high.x_m, yMax: high.y_m };
  }
}

function overlap(one: RectPx, other: RectPx): boolean {
  return one.left < other.right && other.left < one.right && one.top < other.bottom && other.top < one.bottom;
}

/** The box around points; null without any. */
export function boundsOf(points: Iterable<PointM>): Bounds | null {
  let bounds: Bounds | null = null;
  for (const { x_m, y_m } of points) {
    bounds ??= { xMin: x_m, yMin: y_m, xMax: x_m, yMax: y_m };
    bounds.xMin = Math.min(bounds.xMin, x_m);
    bounds.xMax = Math.max(bounds.xMax, x_m);
    bounds.yMin = Math.min(bounds.yMin, y_m);
    bounds.yMax = Math.max(bounds.yMax, y_m);
  }
  return bounds;
}

/** A round length of 1, 2 or 5 times a power of ten that is at least `least`. */
export function roundUp(least: number): number {
  const power = 10 ** Math.floor(Math.log10(least));
  for (const step of [1, 2, 5]) if (step * power >= least * (1 - 1e-9)) return step * power;
  return 10 * power;
}
