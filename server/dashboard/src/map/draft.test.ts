import { expect, test } from 'vitest';
import { Draft } from './draft';

test('every change can be taken back, in order', () => {
  const draft = new Draft('waypoints');
  const seen = [JSON.stringify(draft.points)];
  for (const [x_m, y_m] of [
    [0, 0],
    [1, 2],
    [3, 4],
  ] as const) {
    draft.add({ x_m, y_m });
    seen.push(JSON.stringify(draft.points));
  }
  draft.remove(1);
  seen.push(JSON.stringify(draft.points));
  draft.mark();
  draft.move(0, { x_m: 9, y_m: 9 });
  draft.move(0, { x_m: 8, y_m: 8 });
  seen.push(JSON.stringify(draft.points));
  draft.clear();
  while (seen.length > 0) {
    draft.undo();
    expect(JSON.stringify(draft.points)).toBe(seen.pop());
  }
  expect(draft.canUndo).toBe(false);
  draft.undo();
  expect(draft.points).toEqual([]);
});

test('a draft is whole when it is enough for its kind', () => {
  const path = new Draft('waypoints');
  const ground = new Draft('terrain');
  const whole = [0, 1, 2].map((n) => {
    path.add({ x_m: n, y_m: 0 });
    ground.add({ x_m: n, y_m: n * n });
    return [path.isWhole, ground.isWhole];
  });
  expect(whole).toEqual([
    [false, false],
    [true, false],
    [true, true],
  ]);
  const circle = new Draft('circle');
  expect(circle.isWhole).toBe(false);
  circle.setCircle({ x_m: 1, y_m: 1 }, 0);
  expect(circle.radius_m).toBe(0.05);
  expect(circle.isWhole).toBe(true);
});

test('what was typed and is no path is kept, and named', () => {
  const circle = new Draft('circle');
  circle.typeCircle({ x_m: 1, y_m: 1 }, -3);
  expect([circle.radius_m, circle.flaw, circle.isWhole]).toEqual([-3, 'radius', false]);
  circle.typeCircle({ x_m: NaN, y_m: 1 }, 2);
  expect([circle.flaw, circle.isWhole]).toEqual(['center', false]);
  circle.typeCircle({ x_m: 1, y_m: 1 }, 2);
  expect([circle.flaw, circle.isWhole]).toEqual([null, true]);
  const path = new Draft('waypoints', [
    { x_m: 0, y_m: 0 },
    { x_m: 1, y_m: NaN },
  ]);
  expect([path.flaw, path.isWhole]).toEqual([2, false]);
});

test('the nearest point is taken only within reach', () => {
  const draft = new Draft('waypoints', [
    { x_m: 0, y_m: 0 },
    { x_m: 1, y_m: 0 },
  ]);
  expect(draft.nearest({ x_m: 0.9, y_m: 0 }, 0.2)).toBe(1);
  expect(draft.nearest({ x_m: 0.5, y_m: 0.3 }, 0.2)).toBeNull();
});
