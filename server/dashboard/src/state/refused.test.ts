import { expect, test } from 'vitest';
import { Problem } from '../api/client';
import type { ProblemBody } from '../api/schema';
import { refusalText } from './refused';

const refused = (detail: string, more: Partial<ProblemBody> = {}) => {
  const body: ProblemBody = { type: '/problems/invalid-body', title: 'The body is invalid', status: 422, detail, ...more };
  return new Problem('as the server says it', 422, body);
};
const points = (...pairs: [number, number][]) => pairs.map(([x_m, y_m]) => ({ x_m, y_m }));

test('what the server refuses of points is said in the words of the page, by the numbers of its table', () => {
  const area = (...pairs: [number, number][]) => refusalText(refused('words'), true, { points: points(...pairs), isArea: true });
  expect(area([0, 0], [4, 0], [4, 4], [2, 0], [0, 4])).toBe('The side from corner 1 crosses or touches the side from corner 3.');
  expect(area([0, 0], [4, 0], [4, 4], [4, 4])).toBe('Corners 3 and 4 are the same point.');
  const path = { points: points([0, 0], [0, 0], [4, 0]), isArea: false };
  expect(refusalText(refused('words'), true, path)).toBe('Point 2 is at the same place as the one before.');
  const tight = refused('words', { type: '/problems/turn-too-sharp', place: { point: { x_m: 4, y_m: 0 }, waypoint: 4 } });
  expect(refusalText(tight, true)).toBe('The path turns too sharply near point 5.');
});

test('for what the page has no words the server is quoted, with the numbers of the table', () => {
  const text = refusalText(refused('points[2].speed_m_s must be 0.05 to 50, not 90'), true);
  expect(text).toContain('speed_m_s of point 3 must be 0.05 to 50, not 90');
  expect(text).not.toContain('points[2]');
  expect(refusalText(new Problem('The server does not answer.', 0), true)).toBe('The server does not answer.');
});
