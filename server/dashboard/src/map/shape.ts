// What makes corners no area, or points no path: the rules of the API (`api/src/geometry.rs`, `api/src/trajectory/rules.rs`).
// With them the page says what is wrong with a shape that the server refuses, and at which points: the API has one type
// for all of that. Pure.
import type { PointM } from './camera';
import { COORDINATE_MAX_M } from './draft';

/** Least distance of neighbouring points of a path, metres. */
const SPACING_MIN_M = 0.01;

/** What is drawn: the corners of an area, or the points of a path. */
export interface Shape {
  points: readonly PointM[];
  isArea: boolean;
}

export interface ShapeFlaw {
  kind: 'crosses' | 'same' | 'repeats' | 'far';
  /** Numbers of the points or corners, from 1. */
  points: readonly number[];
}

interface Side {
  from: PointM;
  to: PointM;
}

/** The first flaw of a shape; null if it has none. */
export function flawOfShape({ points, isArea }: Shape): ShapeFlaw | null {
  const far = points.findIndex(({ x_m, y_m }) => !(Math.abs(x_m) <= COORDINATE_MAX_M && Math.abs(y_m) <= COORDINATE_MAX_M));
  if (far >= 0) return { kind: 'far', points: [far + 1] };
  if (isArea) return flawOfArea(points);
  const repeated = points.findIndex((point, index) => {
    const before = points[index - 1];
    return before !== undefined && Math.hypot(point.x_m - before.x_m, point.y_m - before.y_m) < SPACING_MIN_M;
  });
  return repeated < 0 ? null : { kind: 'repeats', points: [repeated + 1] };
}

function flawOfArea(corners: readonly PointM[]): ShapeFlaw | null {
  const count = corners.length;
  const sides = corners.map((from, index): Side => ({ from, to: corners[(index + 1) % count] ?? from }));
  const empty = sides.findIndex(({ from, to }) => isAt(from, to));
  if (empty >= 0) return { kind: 'same', points: [empty + 1, ((empty + 1) % count) + 1] };
  for (const [first, side] of sides.entries()) {
    for (const [second, other] of sides.entries()) {
      if (second <= first) continue;
      const areNeighbours = second === first + 1 || (first === 0 && second === count - 1);
      if (areNeighbours ? foldsBack(side, other) : touches(side, other)) return { kind: 'crosses', points: [first + 1, second + 1] };
    }
  }
  return null;
}

const isAt = (a: PointM, b: PointM) => a.x_m === b.x_m && a.y_m === b.y_m;

/** Twice the signed area of the triangle with a third point. */
function cross({ from, to }: Side, point: PointM): number {
  return (to.x_m - from.x_m) * (point.y_m - from.y_m) - (to.y_m - from.y_m) * (point.x_m - from.x_m);
}

function hasInBox({ from, to }: Side, { x_m, y_m }: PointM): boolean {
  const isBetween = (value: number, a: number, b: number) => value >= Math.min(a, b) && value <= Math.max(a, b);
  return isBetween(x_m, from.x_m, to.x_m) && isBetween(y_m, from.y_m, to.y_m);
}

/** Whether two sides without a common corner have a point in common. */
function touches(side: Side, other: Side): boolean {
  const [from, to] = [cross(side, other.from), cross(side, other.to)];
  const [ownFrom, ownTo] = [cross(other, side.from), cross(other, side.to)];
  if (from !== 0 && to !== 0 && ownFrom !== 0 && ownTo !== 0) return from > 0 !== to > 0 && ownFrom > 0 !== ownTo > 0;
  return (
    (from === 0 && hasInBox(side, other.from)) ||
    (to === 0 && hasInBox(side, other.to)) ||
    (ownFrom === 0 && hasInBox(other, side.from)) ||
    (ownTo === 0 && hasInBox(other, side.to))
  );
}

/** Whether two neighbouring sides overlap, instead of sharing only their corner. */
function foldsBack(side: Side, other: Side): boolean {
  const [start, shared, end] = isAt(side.to, other.from) ? [side.from, side.to, other.to] : [side.to, side.from, other.from];
  const along = (start.x_m - shared.x_m) * (end.x_m - shared.x_m) + (start.y_m - shared.y_m) * (end.y_m - shared.y_m);
  return cross({ from: start, to: shared }, end) === 0 && along > 0;
}
