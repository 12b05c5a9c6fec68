import { expect, test } from 'vitest';
import type { Stop } from '../api/schema';
import { FLEET, Stops } from './stops.svelte';

const stop = (robot: string, confirmed_at: string | null): Stop =>
  ({ id: `stop-of-${robot}`, site: 'yard', robot, by: 'demo', confirmed_at }) as Stop;
const AT = '2026-11-22T06:00:00Z';
const failed = { state: 'failed', text: () => 'It does not answer.' } as const;

test('something is wrong with a stop that is not confirmed or that failed, and with no other one', () => {
  const stops = new Stops(() => 'yard', (robot) => robot);
  stops.inForce.set('a', stop('a', null));
  stops.inForce.set('b', stop('b', AT));
  stops.sent.set('c', failed);
  stops.sent.set('d', { state: 'sending' });
  const problems = () => ['a', 'b', 'c', 'd', 'e'].map((robot) => stops.problemOf(robot));
  expect(problems()).toEqual(['unconfirmed', null, 'failed', null, null]);
  stops.inForce.set('a', stop('a', AT));
  stops.sent.delete('c');
  expect(problems()).toEqual([null, null, null, null, null]);
});

test('a stop of all robots that failed has failed for each that is not stopped otherwise', () => {
  const stops = new Stops(() => 'yard', (robot) => robot);
  stops.sent.set(FLEET, failed);
  stops.inForce.set('b', stop('b', AT));
  expect(stops.problemOf('a')).toBe('failed');
  expect(stops.problemOf('b')).toBe(null);
  stops.sent.set(FLEET, { state: 'sending' });
  expect(stops.problemOf('a')).toBe(null);
});
