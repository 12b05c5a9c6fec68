import { expect, test } from 'vitest';
import { flawOfShape } from './shape';

const points = (...pairs: [number, number][]) => pairs.map(([x_m, y_m]) => ({ x_m, y_m }));
const area = (...pairs: [number, number][]) => flawOfShape({ points: points(...pairs), isArea: true });
const path = (...pairs: [number, number][]) => flawOfShape({ points: points(...pairs), isArea: false });

test('an area and a path without flaws have none', () => {
  expect(area([0, 0], [4, 0], [4, 3], [0, 3])).toBeNull();
  expect(area([0, 0], [4, 0], [2, 1], [0, 3])).toBeNull();
  // A corner on a straight line is allowed.
  expect(area([0, 0], [2, 0], [4, 0], [4, 3])).toBeNull();
  expect(path([0, 0], [0.02, 0], [0, 0])).toBeNull();
});

test('sides that cross, touch or fold back are named by the corners at which they begin', () => {
  expect(area([-9, -9], [-5, -9], [-9, -7], [-4, -8])).toEqual({ kind: 'crosses', points: [2, 4] });
  expect(area([0, 0], [4, 0], [4, 4], [2, 0], [0, 4])).toEqual({ kind: 'crosses', points: [1, 3] });
  expect(area([0, 0], [4, 0], [2, 0], [2, 3])).toEqual({ kind: 'crosses', points: [1, 2] });
});

test('corners and points at one place, or far away, are named by their numbers', () => {
  expect(area([0, 0], [4, 0], [4, 0], [0, 3])).toEqual({ kind: 'same', points: [2, 3] });
  expect(area([0, 0], [4, 0], [0, 3], [0, 0])).toEqual({ kind: 'same', points: [4, 1] });
  expect(path([0, 0], [4, 0], [4, 0.009])).toEqual({ kind: 'repeats', points: [3] });
  expect(path([0, 0], [4, 1_000_001])).toEqual({ kind: 'far', points: [2] });
  expect(area([0, 0], [4, 0], [NaN, 3])).toEqual({ kind: 'far', points: [3] });
});
