import { expect, test } from 'vitest';
import type { ProblemBody } from './api/schema';
import { tell } from './api/client';
import { parted, withDetail } from './said';

test('a sentence and what the server adds are separated again, also within another sentence', () => {
  expect(parted(withDetail('The path leaves the geofence.', 'at 3.2 m'))).toEqual({
    sentence: 'The path leaves the geofence.',
    detail: 'at 3.2 m',
  });
  expect(parted(withDetail('Alone.', null))).toEqual({ sentence: 'Alone.', detail: null });
  expect(parted(`rover-1: not stopped. ${withDetail('The robot is unknown.', 'no robot `rover-1`')}`)).toEqual({
    sentence: 'rover-1: not stopped. The robot is unknown.',
    detail: 'no robot `rover-1`',
  });
});

test('a problem is a sentence by its type, and the words of the server are its detail', () => {
  const body = { type: '/problems/unknown-robot', title: 'the robot is not known', status: 404, detail: 'no `rover-9`' };
  expect(parted(tell(body as ProblemBody))).toEqual({ sentence: 'The robot is not known.', detail: 'no `rover-9`' });
});
