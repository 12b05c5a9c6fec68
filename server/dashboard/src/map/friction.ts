// The friction layer: cells to an image, with a fixed range for each quantity.
import type { CellFriction, FusedFriction } from '../api/schema';
import { words } from '../words';
import { colour } from './cividis';
import type { Bounds, PointM } from './camera';

export type Quantity = 'theta' | 'stiffness' | 'grip' | 'age' | 'visits';

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
    label: words.map.theta,
    ticks: [0.05, 0.1, 0.2, 0.5, 1, 2],
    value: (friction) => friction.theta,
  },
  stiffness: {
    low: 0.5,
    high: 20,
    isLog: true,
    unit: '',
    label: words.map.stiffness,
    ticks: [0.5, 1, 2, 5, 10, 20],
    value: (friction) => friction.stiffness,
  },
  grip: {
    low: 0,
    high: 1,
    isLog: false,
    unit: '',
    label: words.map.grip,
    ticks: [0, 0.25, 0.5, 0.75, 1],
    value: (friction) => friction.mu_peak_lower_bound ?? null,
  },
  age: {
    low: 1 / 60,
    high: 720,
    isLog: true,
    unit: words.unit.h,
    label: words.map.age,
    ticks: [1 / 60, 1, 24, 720],
    value: (friction, nowMs) => Math.max(0, nowMs - Date.parse(friction.newest_at)) / 3_600_000,
  },
  visits: {
    low: 1,
    high: 1_000,
    isLog: true,
    unit: '',
    label: words.map.visits,
    ticks: [1, 10, 100, 1_000],
    value: (friction) => friction.segments,
  },
};

/** Relative deviation up to which a value keeps its colour, and from which it is grey. */
const SURE = 0.05;
const UNSURE = 0.5;
/** Relative deviation from which a cell is hatched. */
export const HATCHED = 0.25;
/** More cells than any site has along one side; its square is still a whole number. */
const KEY_SPAN = 2 ** 26;
/** Most cells along one side of the image. */
const SIDE_MAX = 2_048;

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
export class Layer {
  readonly cells = new Map<number, CellFriction>();
  image: HTMLCanvasElement | null = null;
  /** What the image covers, metres. */
  bounds: Bounds | null = null;
  readonly unsure: CellFriction[] = [];

  constructor(
    cells: CellFriction[],
    readonly configuration: string | null,
    readonly cellM: number,
    readonly quantity: Quantity,
    nowMs: number,
  ) {
    for (const cell of cells) {
      if (configuration && cell.configuration !== configuration) continue;
      const key = keyOf(cell.cell.ix, cell.cell.iy);
      const known = this.cells.get(key);
      if (!known || known.friction.segments < cell.friction.segments) this.cells.set(key, cell);
    }
    this.#paint(nowMs);
  }

  at(point: PointM): CellFriction | null {
    const key = keyOf(Math.floor(point.x_m / this.cellM), Math.floor(point.y_m / this.cellM));
    return this.cells.get(key) ?? null;
  }

  #paint(nowMs: number): void {
    const cells = [...this.cells.values()];
    if (cells.length === 0) return;
    let [xMin, yMin, xMax, yMax] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { cell } of cells) {
      xMin = Math.min(xMin, cell.ix);
      yMin = Math.min(yMin, cell.iy);
      xMax = Math.max(xMax, cell.ix);
      yMax = Math.max(yMax, cell.iy);
    }
    const width = Math.min(SIDE_MAX, xMax - xMin + 1);
    const height = Math.min(SIDE_MAX, yMax - yMin + 1);
    const canvas = document.createElement('canvas');
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext('2d');
    if (!context) return;
    const pixels = context.createImageData(width, height);
    const range = RANGES[this.quantity];
    for (const cell of cells) {
      const value = range.value(cell.friction, nowMs);
      const [column, row] = [cell.cell.ix - xMin, yMin + height - 1 - cell.cell.iy];
      if (value === null || column >= width || row < 0) continue;
      const [red, green, blue] = colour(share(range, value), doubt(cell.friction));
      pixels.data.set([red, green, blue, 255], (row * width + column) * 4);
      if (cell.friction.std_dev > HATCHED * cell.friction.theta) this.unsure.push(cell);
    }
    context.putImageData(pixels, 0, 0);
    this.image = canvas;
    this.bounds = {
      xMin: xMin * this.cellM,
      yMin: yMin * this.cellM,
      xMax: (xMin + width) * this.cellM,
      yMax: (yMin + height) * this.cellM,
    };
  }
}

/** Both in one number, which takes a fraction of the room and time of a text. */
function keyOf(ix: number, iy: number): number {
  return ix * KEY_SPAN + iy;
}
