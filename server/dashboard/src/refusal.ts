// What a problem of the API says of a draft: which of its points, and which field. The API counts points
// from 0, the table of the page from 1. Pure.
//
// What is wrong comes from the problem's type and from what is drawn, where comes from its `field` and `place`. The API's
// sentence is only quoted.
import type { ProblemBody } from './api/schema';
import { flawOfShape, type Shape } from './map/shape';

/** What a refusal is about, as far as the page has its own words for it. */
export type Refused = 'crosses' | 'same' | 'repeats' | 'tight' | 'far';
export type Axis = 'x_m' | 'y_m';
/** A field of the form of a draft, beside its points. */
export type DraftField = 'center' | 'radius' | 'speed' | 'turns' | 'priority';

/** What of a draft is at fault. */
export interface Faults {
  /** Numbers of points or corners in the table, from 1. */
  points: readonly number[];
  /** The coordinate of these points; null for both. */
  axis: Axis | null;
  field: DraftField | null;
}

export const NO_FAULTS: Faults = { points: [], axis: null, field: null };

/** Paths of a point in `field`, as `polygon[3].x_m` or `/corners/3/x_m`. */
const PATH = /(?:polygon|corners|points|keep_(?:in|out)(?:\[\d+\]|\/\d+))(?:\[(\d+)\]|\/(\d+))(?:[./](x_m|y_m))?/;
/** Paths of a field of the form in `field`, as `trajectory.circle.center.x_m`; options of a trajectory have no field. */
const FORM_PATH = /^(?:trajectory\.(?:circle|waypoints)\.)?(center|radius_m|speed_m_s|period_s|turns|priority)\b/;
/** Fields of the form by their names in the API. */
const FIELDS: Readonly<Record<string, DraftField>> = {
  center: 'center',
  radius_m: 'radius',
  speed_m_s: 'speed',
  period_s: 'speed',
  turns: 'turns',
  priority: 'priority',
};

export interface Refusal extends Faults {
  kind: Refused | null;
  /** The server's own words, with the numbers of the table. */
  detail: string | null;
}

/** Reads a problem about a draft that has points, or about a circle; with the shape that is drawn, if that is known. */
export function refusalOf(body: ProblemBody, hasPoints: boolean, shape: Shape | null = null): Refusal {
  const detail = body.detail ? counted(body.detail) : null;
  const flaw = hasPoints && shape && body.type === '/problems/invalid-body' ? flawOfShape(shape) : null;
  if (flaw) return { ...flaw, axis: axisOf(body), field: null, detail };
  const point = hasPoints ? pointOf(body) : null;
  if (point === null) return { kind: null, points: [], axis: null, field: fieldOf(body), detail };
  const kind = body.type === '/problems/turn-too-sharp' ? 'tight' : null;
  return { kind, points: [point], axis: axisOf(body), field: null, detail };
}

/** The number of the point in the table; null if the problem names none. */
function pointOf({ field, place }: ProblemBody): number | null {
  const path = PATH.exec(field ?? '');
  const index = path ? Number(path[1] ?? path[2]) : place?.waypoint;
  return index === null || index === undefined ? null : index + 1;
}

function axisOf(body: ProblemBody): Axis | null {
  return (PATH.exec(body.field ?? '')?.[3] as Axis | undefined) ?? null;
}

function fieldOf(body: ProblemBody): DraftField | null {
  return FIELDS[FORM_PATH.exec(body.field ?? '')?.[1] ?? ''] ?? null;
}

/** A sentence of the server with the numbers that the table has: indices of the API begin at 0. */
export function counted(said: string): string {
  const next = (index: string) => String(Number(index) + 1);
  return said
    .replace(/\bcorners (\d+) and (\d+)\b/g, (_, first: string, second: string) => `corners ${next(first)} and ${next(second)}`)
    .replace(/\b(corner|waypoint) (\d+)\b/g, (_, what: string, index: string) => `${what} ${next(index)}`)
    .replace(/\bpoints\[(\d+)\](?:\.(\w+))?/g, (_, index: string, part?: string) =>
      part ? `${part} of point ${next(index)}` : `point ${next(index)}`,
    );
}
