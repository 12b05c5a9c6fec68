import { expect, test } from 'vitest';
import { areaM2 } from './area';

test('an area does not depend on the direction of its corners', () => {
  const corners = [
    { x_m: 1, y_m: 1 },
    { x_m: 4, y_m: 1 },
    { x_m: 1, y_m: 5 },
  ];
  expect(areaM2(corners)).toBe(6);
  expect(areaM2([...corners].reverse())).toBe(6);
  expect(areaM2([])).toBe(0);
});
