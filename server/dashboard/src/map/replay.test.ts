import { expect, test } from 'vitest';
import { Track, distance } from './replay';

const line = [
  { x_m: 0, y_m: 0 },
  { x_m: 4, y_m: 0 },
  { x_m: 4, y_m: 2 },
];

test('a robot is between its points by time, stands in a pause, and is nowhere beyond the ends', () => {
  const track = new Track([...line.slice(0, 2), { x_m: 4, y_m: 0 }, line[2]!], [0, 4, 9, 11], line);
  expect(track.at(1).at).toEqual({ x_m: 1, y_m: 0 });
  expect(track.at(6).at).toEqual({ x_m: 4, y_m: 0 });
  expect(track.at(6).course_rad).toBeCloseTo(0);
  expect(track.at(10).at).toEqual({ x_m: 4, y_m: 1 });
  expect(track.at(10).course_rad).toBeCloseTo(Math.PI / 2);
  expect(track.at(-5).at).toEqual(line[0]);
  expect(track.at(99).at).toEqual(line[2]);
  expect([track.from_s, track.to_s]).toEqual([0, 11]);
});

test('the error is the distance from the planned path, and unknown without one', () => {
  const beside = line.map(({ x_m, y_m }) => ({ x_m, y_m: y_m + 0.1 }));
  const track = new Track(beside, [0, 4, 6], line);
  expect(track.errorAt(2)).toBeCloseTo(0.1);
  expect(Math.max(...track.errors_m)).toBeLessThan(0.1001);
  expect(new Track(beside, [0, 4, 6], []).errorAt(2)).toBeNull();
  expect(distance({ x_m: 5, y_m: 1 }, line)).toBeCloseTo(1);
});

test('times that are not those of the points are none', () => {
  expect(Track.isTimed(line, [0, 1, 2])).toBe(true);
  expect(Track.isTimed(line, [0, 1])).toBe(false);
  expect(Track.isTimed(line, undefined)).toBe(false);
});
