// What a problem of the API says of a draft: which of its points, and which field. The API counts points
// from 0, the table of the page from 1. Pure.
//
// What is wrong comes from the problem's type and from what is drawn, where comes from its `field` and `place`. The API
// has no code for a turn that is too sharp, and no field for a part of a circle: only these are looked for in its sentence,
// and what is not found there is quoted.
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

/** How the server names points in what it says; every number in them is an index. */
const POINTS: readonly [RegExp, Refused | null][] = [
  [/\bside from corner (\d+)\b.*\bside from corner (\d+)\b/, 'crosses'],
  [/\bcorners (\d+) and (\d+) are the same point/, 'same'],
  [/\bcorner (\d+) is not within/, 'far'],
  [/\bpoints\[(\d+)\] must be within/, 'far'],
  [/\bpoints\[(\d+)\] repeats the point before/, 'repeats'],
  [/\bwaypoint (\d+) is at the same place/, 'repeats'],
  [/\bnear waypoint (\d+)\b/, 'tight'],
  [/\bpoints\[(\d+)\]/, null],
  [/\b(?:corner|waypoint) (\d+)\b/, null],
];
/** Paths of a point in `field`, as `polygon[3].x_m` or `/corners/3/x_m`. */
const PATH = /(?:polygon|corners|points|keep_(?:in|out)(?:\[\d+\]|\/\d+))(?:\[(\d+)\]|\/(\d+))(?:[./](x_m|y_m))?/;
/** What words of a refusal mean which field. */
const FIELDS: readonly [RegExp, DraftField][] = [
  [/\bradius/, 'radius'],
  [/\bturns\b/, 'turns'],
  [/\bspeed/, 'speed'],
  [/\bcentre\b|\bcenter\b/, 'center'],
  [/\bpriority\b/, 'priority'],
];

export interface Refusal extends Faults {
  kind: Refused | null;
  /** The server's own words, with the numbers of the table. */
  detail: string | null;
}

/** Reads a problem about a draft that has points, or about a circle; with the shape that is drawn, if that is known. */
export function refusalOf(body: ProblemBody, hasPoints: boolean, shape: Shape | null = null): Refusal {
  const said = body.detail ?? '';
  const fieldIn = (text: string) => FIELDS.find(([words]) => words.test(text))?.[1] ?? null;
  const field = fieldIn(body.field ?? '') ?? fieldIn(said);
  // A circle has no waypoints, whatever it was planned by.
  if (!hasPoints) return { kind: null, points: [], axis: null, field, detail: said.replace(/ near waypoint \d+/, '') || null };
  const flaw = shape && body.type === '/problems/invalid-body' ? flawOfShape(shape) : null;
  if (flaw) return { ...flaw, axis: axisOf(body), field: null, detail: counted(said) };
  const path = PATH.exec(body.field ?? '');
  const index = path ? Number(path[1] ?? path[2]) : body.place?.waypoint;
  const points = index === null || index === undefined ? null : [index + 1];
  for (const [words, kind] of POINTS) {
    const found = words.exec(said)?.slice(1).map((index) => Number(index) + 1);
    if (found) return { kind, points: points ?? found, axis: axisOf(body), field: null, detail: counted(said) };
  }
  return { kind: null, points: points ?? [], axis: axisOf(body), field: points ? null : field, detail: said ? counted(said) : null };
}

function axisOf(body: ProblemBody): Axis | null {
  return (PATH.exec(body.field ?? '')?.[3] as Axis | undefined) ?? null;
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
