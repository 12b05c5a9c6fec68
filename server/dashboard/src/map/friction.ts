// The friction layer: cells to an image, with a fixed range for each quantity.
import type { CellFriction, FusedFriction } from '../api/schema';
import { texts } from '../texts';
import { colour } from './cividis';
import { Raster } from './raster';

export type Quantity = 'theta' | 'stiffness' | 'friction' | 'age' | 'visits';

export interface Range {
  low: number;
  high: number;
  isLog: boolean;
  unit: string;
  label: string;
  /** What the legend names between its ends. */
  ticks: number[];
  value(friction: FusedFriction, nowMs: number): number | null;
}

/** The ranges are fixed, so that colours mean the same from day to day. */
export const RANGES: Record<Quantity, Range> = {
  theta: {
    low: 0.05,
    high: 2,
    isLog: true,
    unit: '',
    label: texts.map.theta,
    ticks: [0.05, 0.1, 0.2, 0.5, 1, 2],
    value: (friction) => friction.theta,
  },
  stiffness: {
    low: 0.5,
    high: 20,
    isLog: true,
    unit: '',
    label: texts.map.stiffness,
    ticks: [0.5, 1, 2, 5, 10, 20],
    value: (friction) => friction.stiffness,
  },
  friction: {
    low: 0,
    high: 1,
    isLog: false,
    unit: '',
    label: texts.map.peakFriction,
    ticks: [0, 0.25, 0.5, 0.75, 1],
    value: (friction) => friction.mu_peak_lower_bound ?? null,
  },
  age: {
    low: 1 / 60,
    high: 720,
    isLog: true,
    unit: texts.unit.h,
    label: texts.map.age,
    ticks: [1 / 60, 1, 24, 720],
    value: (friction, nowMs) => Math.max(0, nowMs - Date.parse(friction.newest_at)) / 3_600_000,
  },
  visits: {
    low: 1,
    high: 1_000,
    isLog: true,
    unit: '',
    label: texts.map.visits,
    ticks: [1, 10, 100, 1_000],
    value: (friction) => friction.segments,
  },
};

/** Relative standard deviation up to which a value keeps its colour, and from which it is grey. */
const SURE = 0.05;
const UNSURE = 0.5;
/** Relative standard deviation from which a cell is hatched. */
export const HATCHED = 0.25;
/** Where a value stands in its range, 0 to 1. */
export function share(range: Range, value: number): number {
  const of = (number: number) => (range.isLog ? Math.log(Math.max(number, 1e-12)) : number);
  const at = (of(value) - of(range.low)) / (of(range.high) - of(range.low));
  return Math.min(1, Math.max(0, at));
}

/** How unsure a value is, 0 to 1. */
export function doubt(friction: FusedFriction): number {
  const relative = friction.std_dev / friction.theta;
  return Math.min(1, Math.max(0, (relative - SURE) / (UNSURE - SURE)));
}

/** Cells of one robot model; where two terrains share one, the one that was measured more often. */
export class Layer extends Raster<CellFriction> {
  constructor(
    cells: CellFriction[],
    readonly configuration: string | null,
    cellM: number,
    readonly quantity: Quantity,
    nowMs: number,
  ) {
    const mine = cells.filter((cell) => !configuration || cell.configuration === configuration);
    super(mine, cellM, (known, other) => known.friction.segments < other.friction.segments);
    const range = RANGES[quantity];
    this.paint((cell) => {
      const value = range.value(cell.friction, nowMs);
      if (value === null) return null;
      return {
        colour: colour(share(range, value), doubt(cell.friction)),
        isHatched: cell.friction.std_dev > HATCHED * cell.friction.theta,
      };
    });
  }
}
