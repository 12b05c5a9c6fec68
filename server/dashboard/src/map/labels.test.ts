import { expect, test } from 'vitest';
import { CROWD_MIN, LABEL_PX, Labels, crowdOf, overlap, shortened, type Member, type Wanted } from './labels';

const widthOf = (text: string) => 7 * text.length;

/** Robots in a square, one every so many pixels. */
function square(side: number, apart: number, shift = 0): Wanted[] {
  return Array.from({ length: side * side }, (_, index) => ({
    id: `rover-${index}`,
    x: (index % side) * apart + shift,
    y: Math.floor(index / side) * apart,
    reach: 8,
    texts: [`rover-${index} · late`, `rover-${index}`, String(index)],
  }));
}

function overlaps(placed: ReturnType<Labels['place']>): number {
  let count = 0;
  placed.forEach((a, index) => placed.slice(index + 1).forEach((b) => (count += overlap(a, b) ? 1 : 0)));
  return count;
}

test('each robot has its label, also where there is no room for any', () => {
  for (const apart of [300, 60, 40, 12, 0]) {
    const wanted = square(22, apart);
    const placed = new Labels().place(wanted, widthOf);
    expect(placed.map((label) => label.id)).toEqual(wanted.map((one) => one.id));
    for (const [index, label] of placed.entries()) {
      expect(wanted[index]?.texts).toContain(label.text);
      expect(label.width * label.height).toBeGreaterThan(0);
    }
  }
});

test('labels are whole where there is room, shorter where there is less, and only then over each other', () => {
  const texts = (apart: number) => new Labels().place(square(10, apart), widthOf);
  expect(texts(300).every((label) => label.text.endsWith('late'))).toBe(true);
  const close = texts(42);
  expect(overlaps(close)).toBe(0);
  expect(close.some((label) => /^\d+$/.test(label.text))).toBe(true);
  const crowd = texts(4);
  expect(crowd.some((label) => label.isOver)).toBe(true);
  for (const label of crowd.filter((one) => one.isOver)) expect(label.text).toMatch(/^\d+$/);
});

test('a label keeps off the sign above a robot while there is room elsewhere', () => {
  const wanted: Wanted[] = [{ id: 'rover-1', x: 100, y: 100, reach: 8, texts: ['rover-1'] }];
  const sign = { left: 110, top: 80, width: 60, height: 40 };
  const [label] = new Labels().place(wanted, widthOf, undefined, [sign]);
  expect(label && overlap(label, sign)).toBe(false);
});

const NOBODY: ReadonlySet<string> = new Set();
const members = (side: number, apart: number): Member[] => square(side, apart).map((one) => ({ ...one, width: 62 }));

test('five hundred robots on one screen are a crowd to their edges, and none where each name has its room', () => {
  expect(crowdOf(members(22, 35), NOBODY).size).toBe(484);
  expect(crowdOf(members(22, 12), NOBODY).size).toBe(484);
  expect(crowdOf(members(22, 150), NOBODY).size).toBe(0);
});

test('few robots are no crowd, however close together they are', () => {
  const few = members(5, 10).slice(0, CROWD_MIN - 1);
  expect(crowdOf(few, NOBODY).size).toBe(0);
});

test('a robot apart from a crowd is not in it, and neither is a row of robots', () => {
  const apart: Member = { id: 'apart', x: 900, y: 500, reach: 8, width: 62 };
  const crowd = crowdOf([...members(6, 20), apart], NOBODY);
  expect(crowd.size).toBe(36);
  expect(crowd.has('apart')).toBe(false);
  const row = Array.from({ length: 40 }, (_, index): Member => ({ id: `${index}`, x: index * 45, y: 0, reach: 8, width: 62 }));
  expect(crowdOf(row, NOBODY).size).toBe(0);
});

test('a robot at the limit of a crowd stays as it was', () => {
  // Six others are near the one in the middle, then five.
  const ring = (count: number): Member[] => [
    { id: 'middle', x: 0, y: 0, reach: 8, width: 40 },
    ...Array.from({ length: count }, (_, index) => ({ id: `${index}`, x: 45, y: (index - count / 2) * 6, reach: 8, width: 40 })),
  ];
  const others = Array.from({ length: CROWD_MIN }, (_, index): Member => ({ id: `far-${index}`, x: 5_000 + index * 500, y: 0, reach: 8, width: 40 }));
  const isIn = (count: number, before: ReadonlySet<string>) => crowdOf([...ring(count), ...others], before).has('middle');
  expect(isIn(6, NOBODY)).toBe(true);
  expect(isIn(5, new Set(['middle']))).toBe(true);
  expect(isIn(4, new Set(['middle']))).toBe(false);
});

test('a label stays beside its robot', () => {
  for (const { id, left, top, width, height } of new Labels().place(square(15, 25), widthOf)) {
    const robot = square(15, 25).find((one) => one.id === id);
    if (!robot) throw new Error(id);
    const dx = Math.max(left - robot.x, robot.x - left - width, 0);
    const dy = Math.max(top - robot.y, robot.y - top - height, 0);
    expect(Math.hypot(dx, dy)).toBeLessThan(robot.reach + LABEL_PX);
  }
});

test('labels of robots at the edge are within the map', () => {
  const view = { left: 0, top: 0, width: 300, height: 200 };
  const corners: Wanted[] = [0, 300].flatMap((x) => [0, 200].map((y) => ({ id: `${x} ${y}`, x, y, reach: 8, texts: ['rover-1'] })));
  for (const { left, top, width, height } of new Labels().place(corners, widthOf, view)) {
    expect([left >= 0, top >= 0, left + width <= 300, top + height <= 200]).toEqual([true, true, true, true]);
  }
});

test('a label that has its room stays on its side while its robot moves', () => {
  const labels = new Labels();
  const sides = (shift: number) =>
    labels.place(square(8, 70, shift), widthOf).map(({ left, id }, index) => {
      const robot = square(8, 70, shift)[index];
      return `${id} ${left > (robot?.x ?? 0)}`;
    });
  const first = sides(0);
  for (let shift = 1; shift < 20; shift += 1) expect(sides(shift)).toEqual(first);
});

test('names are shortened to what differs', () => {
  expect([...shortened(['rover-1', 'rover-12', 'rover-120']).values()]).toEqual(['1', '12', '120']);
  expect([...shortened(['Old Betsy', 'Anna', 'tractor-north']).values()]).toEqual(['…etsy', 'Anna', '…orth']);
  expect([...shortened(['rover-1']).values()]).toEqual(['…er-1']);
  expect([...shortened(['rover-', 'rover-1']).values()]).toEqual(['rover-', '…er-1']);
  expect(shortened([]).size).toBe(0);
});
