// The friction layer: cells to an image, with a fixed range for each quantity.
import type { CellFriction, FusedFriction } from '../api/schema';
import { texts } from '../texts';
import { colour as cividis } from './cividis';
import { Raster, type Hatch } from './raster';
import { slate, teal, type Rgb } from './single_hue';

export type Quantity = 'theta' | 'stiffness' | 'friction' | 'age' | 'visits';

export interface Range {
  low: number;
  high: number;
  isLog: boolean;
  readonly unit: string;
  readonly label: string;
  /** What the legend names between its ends. */
  ticks: number[];
  /** What its ends mean, the lower one first. */
  readonly ends: readonly [string, string];
  /** Says in one plain sentence what it is. */
  readonly plain: string;
  /** Its colour map. Cividis is that of slip alone, so that no colour means opposite things. */
  scale: (share: number) => Rgb;
  /** Colours go from the higher end to the lower one, so that ground that is slippery looks the same. */
  isReversed: boolean;
  /** Whether hatching says how sure the value is. */
  isHatched: boolean;
  value(friction: FusedFriction): number | null;
}

/** The ranges are fixed, so that colours mean the same from day to day. */
export const RANGES: Record<Quantity, Range> = {
  theta: {
    low: 0.05,
    high: 2,
    isLog: true,
    unit: '',
    get label() {
      return texts.map.theta;
    },
    ticks: [0.05, 0.2, 0.5, 1, 2],
    get ends() {
      return [texts.map.ends.firm, texts.map.ends.slippery] as const;
    },
    get plain() {
      return texts.map.plain.theta;
    },
    scale: cividis,
    isReversed: false,
    isHatched: true,
    value: (friction) => friction.theta,
  },
  stiffness: {
    low: 0.5,
    high: 20,
    isLog: true,
    unit: '',
    get label() {
      return texts.map.stiffness;
    },
    ticks: [0.5, 1, 2, 5, 10, 20],
    get ends() {
      return [texts.map.ends.slippery, texts.map.ends.firm] as const;
    },
    get plain() {
      return texts.map.plain.stiffness;
    },
    scale: cividis,
    isReversed: true,
    isHatched: true,
    value: (friction) => friction.stiffness,
  },
  friction: {
    low: 0,
    high: 1,
    isLog: false,
    unit: '',
    get label() {
      return texts.map.peakFriction;
    },
    ticks: [0, 0.25, 0.5, 0.75, 1],
    // A low one says nothing bad: nobody has asked for more there.
    get ends() {
      return [texts.map.ends.littleShown, texts.map.ends.muchShown] as const;
    },
    get plain() {
      return texts.map.plain.friction;
    },
    scale: teal,
    isReversed: false,
    isHatched: false,
    value: (friction) => friction.mu_peak_lower_bound ?? null,
  },
  age: {
    low: 1 / 60,
    high: 720,
    isLog: true,
    get unit() {
      return texts.unit.h;
    },
    get label() {
      return texts.map.age;
    },
    ticks: [1 / 60, 1, 24, 720],
    get ends() {
      return [texts.map.ends.fresh, texts.map.ends.old] as const;
    },
    get plain() {
      return texts.map.plain.age;
    },
    scale: slate,
    isReversed: true,
    isHatched: false,
    value: (friction) => friction.age_s / 3_600,
  },
  visits: {
    low: 1,
    high: 1_000,
    isLog: true,
    unit: '',
    get label() {
      return texts.map.visits;
    },
    ticks: [1, 10, 100, 1_000],
    get ends() {
      return [texts.map.ends.few, texts.map.ends.many] as const;
    },
    get plain() {
      return texts.map.plain.visits;
    },
    scale: slate,
    isReversed: false,
    isHatched: false,
    value: (friction) => friction.segments,
  },
};

/** Relative standard deviations of θ from which a cell is hatched, and more densely. */
export const HATCHED = [0.1, 0.25, 0.5] as const;

/** Where a value stands in its range, 0 to 1. */
export function share(range: Range, value: number): number {
  const of = (number: number) => (range.isLog ? Math.log(Math.max(number, 1e-12)) : number);
  const at = (of(value) - of(range.low)) / (of(range.high) - of(range.low));
  return Math.min(1, Math.max(0, at));
}

/** Where a value stands on the scale of colours, 0 to 1. */
export function shade(range: Range, value: number): number {
  return range.isReversed ? 1 - share(range, value) : share(range, value);
}

/** The colour of a value. */
export function colourOf(range: Range, value: number): Rgb {
  return range.scale(shade(range, value));
}

/** How densely a value of θ is hatched: pattern alone says how unsure it is, never a colour. */
export function hatchOf(friction: FusedFriction): Hatch {
  const relative = friction.std_dev / friction.theta;
  return HATCHED.filter((least) => relative >= least).length as Hatch;
}

/** Cells of one robot model; where two terrains share one, the one that was measured more often. */
export class Layer extends Raster<CellFriction> {
  constructor(
    cells: CellFriction[],
    readonly configuration: string | null,
    cellM: number,
    readonly quantity: Quantity,
  ) {
    const mine = cells.filter((cell) => !configuration || cell.configuration === configuration);
    super(mine, cellM, (known, other) => known.friction.segments < other.friction.segments);
    const range = RANGES[quantity];
    this.paint((cell) => {
      const value = range.value(cell.friction);
      if (value === null) return null;
      return { colour: colourOf(range, value), hatch: range.isHatched ? hatchOf(cell.friction) : 0 };
    });
  }
}
