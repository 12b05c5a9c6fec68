import { expect, test } from 'vitest';
import { serves, windowOn } from './window';

const seen = { xMin: 0, yMin: 0, xMax: 32, yMax: 24 };

test('what is seen from near is read in the squares of the grid, from far in larger ones', () => {
  const near = windowOn(seen, 1, 16_000);
  expect(near.squareM).toBe(1);
  const far = windowOn({ xMin: -500, yMin: -400, xMax: 500, yMax: 400 }, 1, 16_000);
  expect(far.squareM).toBe(16);
  const { bounds } = far;
  const squares = ((bounds.xMax - bounds.xMin) / 16) * ((bounds.yMax - bounds.yMin) / 16);
  expect(squares).toBeLessThanOrEqual(16_000);
  expect(bounds.xMin % 16).toBeCloseTo(0);
});

test('a small move needs no reading, a large one or another zoom does', () => {
  const window = windowOn(seen, 1, 16_000);
  const moved = { ...seen, xMin: 10, xMax: 42 };
  expect(serves(window, moved, 1, 16_000)).toBe(true);
  expect(serves(window, { ...seen, xMin: 30, xMax: 62 }, 1, 16_000)).toBe(false);
  expect(serves(windowOn({ xMin: -500, yMin: -400, xMax: 500, yMax: 400 }, 1, 16_000), seen, 1, 16_000)).toBe(false);
});
