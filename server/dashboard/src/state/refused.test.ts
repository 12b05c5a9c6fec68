import { expect, test } from 'vitest';
import { Problem } from '../api/client';
import type { ProblemBody } from '../api/schema';
import { refusalText } from './refused';

const refused = (detail: string) => {
  const body: ProblemBody = { type: '/problems/invalid-body', title: 'The body is invalid', status: 422, detail };
  return new Problem('as the server says it', 422, body);
};

test('what the server refuses of points is said in the words of the page, by the numbers of its table', () => {
  const text = (detail: string) => refusalText(refused(detail), true);
  expect(text('the side from corner 0 at (0.00 m, 0.00 m) crosses or touches the side from corner 2 at (4.00 m, 0.00 m)')).toBe(
    'The side from corner 1 crosses or touches the side from corner 3.',
  );
  expect(text('corners 2 and 3 are the same point; leave out the closing corner')).toBe('Corners 3 and 4 are the same point.');
  expect(text('waypoint 1 is at the same place as the one before')).toBe('Point 2 is at the same place as the one before.');
  expect(text('the path turns too sharply near waypoint 4')).toBe('The path turns too sharply near point 5.');
});

test('for what the page has no words the server is quoted, with the numbers of the table', () => {
  const text = refusalText(refused('points[2].speed_m_s must be 0.05 to 50, not 90'), true);
  expect(text).toContain('speed_m_s of point 3 must be 0.05 to 50, not 90');
  expect(text).not.toContain('points[2]');
  expect(refusalText(new Problem('The server does not answer.', 0), true)).toBe('The server does not answer.');
});
