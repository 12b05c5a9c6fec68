import { expect, test } from 'vitest';
import { SPANS, momentsOf, momentsWith, stepS } from './moments';

const NOW_MS = Date.parse('2026-11-23T14:37:12Z');

test('the map is had by the minute for an hour, at ends of hours, and of days for a month', () => {
  const hour = momentsOf('hour', NOW_MS);
  expect(new Date(hour.at(-1) ?? 0).toISOString()).toBe('2026-11-23T14:36:00.000Z');
  expect(hour).toHaveLength(61);

  const day = momentsOf('day', NOW_MS);
  expect(new Date(day.at(-1) ?? 0).toISOString()).toBe('2026-11-23T14:00:00.000Z');
  expect(new Date(day[0] ?? 0).toISOString()).toBe('2026-11-22T14:00:00.000Z');
  expect(new Date(momentsOf('month', NOW_MS).at(-1) ?? 0).toISOString()).toBe('2026-11-23T00:00:00.000Z');
  for (const span of SPANS) {
    const moments = momentsOf(span, NOW_MS);
    for (const [index, at] of moments.slice(1).entries()) expect(at - (moments[index] ?? 0)).toBe(stepS(span) * 1000);
    // No more than the history of a terrain may have.
    expect(moments.length).toBeLessThanOrEqual(1000);
  }
});

test('a time that is wanted is among those of the shortest span that reaches back to it', () => {
  const ago = (minutes: number) => NOW_MS - minutes * 60_000;
  for (const [at, wanted, span] of [
    [ago(30), 'hour', 'hour'],
    [ago(300), 'hour', 'day'],
    [ago(300), 'week', 'week'],
    [ago(60 * 24 * 20), 'day', 'month'],
    [ago(60 * 24 * 400), 'hour', 'month'],
  ] as const) {
    const found = momentsWith(at, wanted, NOW_MS);
    expect(found.span).toBe(span);
    expect(found.moments[found.index]).toBe(at);
    expect([...found.moments].sort((a, b) => a - b)).toEqual(found.moments);
  }
});
