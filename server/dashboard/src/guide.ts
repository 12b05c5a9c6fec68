// The first steps with a fleet: a robot that is online, a mission that it drives, and its friction. Pure.
import type { CellFriction, Mission, Robot } from './api/schema';
import { boundsOf, type Bounds, type PointM } from './map/camera';

export const STEPS = ['robot', 'mission', 'friction'] as const;
export type Step = (typeof STEPS)[number];

/** What this browser keeps of the mission that it sent last. */
export interface Sent {
  id: string;
  site: string;
  robot: string;
  /** When it began to drive; null before that. */
  started_at: string | null;
}

/** What was sent, with what is known of it now. */
export function followed(sent: Sent | null, mission: Mission | undefined): Sent | null {
  if (!sent || mission?.id !== sent.id) return sent;
  return { ...sent, started_at: mission.started_at ?? sent.started_at };
}

/** Which steps are done. */
export function doneOf(robots: readonly Robot[], sent: Sent | null, friction: readonly PointM[]): Record<Step, boolean> {
  return {
    robot: robots.some((robot) => robot.link === 'online'),
    mission: sent?.started_at != null,
    friction: friction.length > 0,
  };
}

/** The first step that is not done; null when all are. */
export function nextOf(done: Record<Step, boolean>): Step | null {
  return STEPS.find((step) => !done[step]) ?? null;
}

/** Room around a path in which its cells lie, as cells. */
const AROUND_CELLS = 1;

/** Where the friction of a path lies. */
export function around(path: readonly PointM[], cellM: number): Bounds | null {
  const bounds = boundsOf(path);
  if (!bounds) return null;
  const margin = AROUND_CELLS * cellM;
  return { xMin: bounds.xMin - margin, yMin: bounds.yMin - margin, xMax: bounds.xMax + margin, yMax: bounds.yMax + margin };
}

/** Corners of the cells that were measured since a mission began, by robots of one model. */
export function measuredSince(cells: readonly CellFriction[], since: string, configuration: string | undefined): PointM[] {
  const began_ms = Date.parse(since);
  return cells
    .filter((cell) => cell.configuration === configuration && Date.parse(cell.friction.newest_at) >= began_ms)
    .flatMap(({ cell, size_m }) => [
      { x_m: cell.ix * size_m, y_m: cell.iy * size_m },
      { x_m: (cell.ix + 1) * size_m, y_m: (cell.iy + 1) * size_m },
    ]);
}

/** What is typed on the operator's machine and on the robot, for a robot to join. */
export function enrolment(server: string, site: string): string {
  return [
    `tread robots join-token --site ${site} --expires 1h > token`,
    `tread-agent enroll --server ${server} --token-file token --config robot.toml`,
    'tread-agent --config robot.toml',
  ].join('\n');
}
