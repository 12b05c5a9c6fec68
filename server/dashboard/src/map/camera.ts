// Between metres of the site (y up) and pixels of the canvas (y down).

export interface PointM {
  x_m: number;
  y_m: number;
}

export interface PointPx {
  x: number;
  y: number;
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

  fit(bounds: Bounds): void {
    const width = Math.max(bounds.xMax - bounds.xMin, FIT_MIN_M);
    const height = Math.max(bounds.yMax - bounds.yMin, FIT_MIN_M);
    const scale = Math.min(
      Math.max(1, this.width - 2 * MARGIN_PX) / width,
      Math.max(1, this.height - 2 * MARGIN_PX) / height,
    );
    this.scale = Math.min(SCALE_MAX, Math.max(SCALE_MIN, scale));
    this.center = { x_m: (bounds.xMin + bounds.xMax) / 2, y_m: (bounds.yMin + bounds.yMax) / 2 };
  }

  /** What can be seen. */
  get bounds(): Bounds {
    const low = this.toM({ x: 0, y: this.height });
    const high = this.toM({ x: this.width, y: 0 });
    return { xMin: low.x_m, yMin: low.y_m, xMax: high.x_m, yMax: high.y_m };
  }
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
