import { expect, test } from 'vitest';
import type { CellDifference } from '../api/schema';
import { CHANGE_TICKS, changeColour, changePercent, lookOf, shareOfChange } from './compare';

/** A cell whose θ was one value and is another, so many deviations apart. */
function cell(before: number | null, after: number | null, deviations: number | null): CellDifference {
  const known = (theta: number | null) => (theta === null ? null : { theta, std_dev: 0.01 });
  return { cell: { ix: 0, iy: 0 }, before: known(before), after: known(after), z_score: deviations } as CellDifference;
}

test('where θ rose a cell is red, where it fell blue, and the more the further', () => {
  const [red, , blue] = lookOf(cell(0.2, 0.4, 8)).colour;
  expect(red).toBeGreaterThan(blue + 100);
  const [fallenRed, , fallenBlue] = lookOf(cell(0.4, 0.2, -8)).colour;
  expect(fallenBlue).toBeGreaterThan(fallenRed + 100);
  const [someRed, , someBlue] = lookOf(cell(0.2, 0.26, 4)).colour;
  expect(someRed).toBeGreaterThan(someBlue);
  expect(someRed - someBlue).toBeLessThan(red - blue);
  expect(changePercent(cell(0.2, 0.26, 4))).toBeCloseTo(30);
});

test('what is within chance is white, whatever its percent', () => {
  for (const deviations of [1.9, -1.9, 0]) expect(lookOf(cell(0.2, 0.4, deviations)).colour).toEqual(changeColour(0));
  expect(lookOf(cell(0.2, 0.4, 2.1)).colour).not.toEqual(changeColour(0));
});

test('what only one of the times knows is white and hatched', () => {
  for (const known of [cell(null, 0.4, null), cell(0.4, null, null)]) {
    expect(lookOf(known)).toEqual({ colour: changeColour(0), hatch: 2 });
    expect(changePercent(known)).toBeNull();
  }
  expect(lookOf(cell(0.2, 0.4, 8)).hatch).toBe(0);
});

test('the legend names the ends of the colours', () => {
  const shares = CHANGE_TICKS.map((percent) => shareOfChange(1 + percent / 100));
  expect(shares.map((share) => Number(share.toFixed(9)))).toEqual([-1, 0, 1]);
});
