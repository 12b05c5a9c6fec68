// Where the approach of a planned path ends and what was asked for begins. Pure.
import type { PlannedPath, Trajectory } from '../api/schema';
import type { PointM } from './camera';

export interface Planned {
  points: PointM[];
  /** Points of the approach, the first ones; 0 for none, or where it is not known. */
  approach: number;
}

/** How near a path comes to its first waypoint, in its steps: it goes through it, between two points. */
const THROUGH_STEPS = 0.75;

/** A path whose approach has a known length, as a dry run states it. */
export function withApproach({ points, step_m }: PlannedPath, approach_m: number): Planned {
  const approach = step_m > 0 ? Math.round(approach_m / step_m) : 0;
  return { points, approach: Math.min(Math.max(0, approach), points.length) };
}

/**
 * The path of a mission, of which the API states the whole length alone. The rest of that of a
 * circle is its turns; a path through waypoints begins at the first of them.
 */
export function planned(path: PlannedPath, trajectory: Trajectory, length_m: number | undefined): Planned {
  if ('circle' in trajectory) {
    const { radius_m, turns } = trajectory.circle;
    const asked_m = 2 * Math.PI * radius_m * (turns ?? 1);
    return withApproach(path, length_m === undefined ? 0 : length_m - asked_m);
  }
  const { points, step_m } = path;
  const [first] = trajectory.waypoints.points;
  if (!first) return { points, approach: 0 };
  const found = points.findIndex(
    (point) => Math.hypot(point.x_m - first.x_m, point.y_m - first.y_m) <= THROUGH_STEPS * step_m,
  );
  return { points, approach: Math.max(0, found) };
}
