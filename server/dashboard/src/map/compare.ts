// How cells differ between two times, as a layer: blue where θ fell, red where it rose, white where
// the difference is within chance, hatched where only one of the times knows anything.
import type { CellDifference } from '../api/schema';
import { Raster, type Look } from './raster';

/** Deviations within which a difference is chance. */
export const CHANCE = 2;
/** Change of θ at the ends of the colours, as a natural logarithm: half and twice. */
const MOST = Math.LN2;
/** What the legend names, percent. */
export const CHANGE_TICKS = [-50, 0, 100];
/** Blue to white to red, which all eyes can distinguish: ends and middle. */
const FALLEN = [33, 102, 172] as const;
const SAME = [244, 244, 244] as const;
const RISEN = [178, 24, 43] as const;

/** Where a change stands in its range, −1 to 1. */
export function shareOfChange(ratio: number): number {
  return Math.min(1, Math.max(-1, Math.log(ratio) / MOST));
}

export function changeColour(share: number): [number, number, number] {
  const end = share < 0 ? FALLEN : RISEN;
  const part = Math.min(1, Math.abs(share));
  const mix = (index: 0 | 1 | 2) => Math.round(SAME[index] + part * (end[index] - SAME[index]));
  return [mix(0), mix(1), mix(2)];
}

/** Change of θ in percent; null unless both times know it. */
export function changePercent(cell: CellDifference): number | null {
  return cell.before && cell.after ? (cell.after.theta / cell.before.theta - 1) * 100 : null;
}

/** How a cell looks: coloured as far as it really changed, hatched where one time knows nothing. */
export function lookOf(cell: CellDifference): Look {
  const percent = changePercent(cell);
  const isChance = Math.abs(cell.z_score ?? 0) < CHANCE;
  const share = percent === null || isChance ? 0 : shareOfChange(1 + percent / 100);
  return { colour: changeColour(share), hatch: percent === null ? 2 : 0 };
}

/** Where two terrains or models share a cell, the one that changed most. */
export class Comparison extends Raster<CellDifference> {
  constructor(cells: CellDifference[], cellM: number) {
    const strength = (cell: CellDifference) => Math.abs(cell.z_score ?? 0);
    super(cells, cellM, (known, other) => strength(other) > strength(known));
    this.paint(lookOf);
  }
}
