import { expect, test } from 'vitest';
import type { ProblemBody } from './api/schema';
import { tell } from './api/client';
import { splitMessage, withDetail } from './message';

test('a sentence and what the server adds are separated again, also within another sentence', () => {
  expect(splitMessage(withDetail('The path leaves the geofence.', 'at 3.2 m'))).toEqual({
    sentence: 'The path leaves the geofence.',
    detail: 'at 3.2 m',
  });
  expect(splitMessage(withDetail('Alone.', null))).toEqual({ sentence: 'Alone.', detail: null });
  expect(splitMessage(`rover-1: not stopped. ${withDetail('The robot is unknown.', 'no robot `rover-1`')}`)).toEqual({
    sentence: 'rover-1: not stopped. The robot is unknown.',
    detail: 'no robot `rover-1`',
  });
});

test('a problem is a sentence by its type, and the words of the server are its detail', () => {
  const body = { type: '/problems/unknown-robot', title: 'the robot is not known', status: 404, detail: 'no `rover-9`' };
  expect(splitMessage(tell(body as ProblemBody))).toEqual({ sentence: 'The robot is not known.', detail: 'no `rover-9`' });
});
