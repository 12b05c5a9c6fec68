// Areas of polygons. Pure.
import type { PointM } from './camera';

/** Area of a simple polygon, square metres. */
export function areaM2(polygon: readonly PointM[]): number {
  let doubled = 0;
  polygon.forEach((corner, index) => {
    const next = polygon[(index + 1) % polygon.length] ?? corner;
    doubled += corner.x_m * next.y_m - next.x_m * corner.y_m;
  });
  return Math.abs(doubled) / 2;
}
