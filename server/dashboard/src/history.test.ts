import { expect, test } from 'vitest';
import type { MissionEvent } from './api/schema';
import { collapsed } from './history';

function steps(...words: string[]): MissionEvent[] {
  return words.map((word, second) => {
    const [to, cause] = word.split(' ');
    return { at: `2026-01-01T00:00:${String(second).padStart(2, '0')}Z`, actor: 'server', to, cause } as MissionEvent;
  });
}

const offers = (count: number) => Array.from({ length: count }, () => ['offered offered', 'queued returned']).flat();
const shape = (events: MissionEvent[]) =>
  collapsed(events).map((line) => [line.steps.map((step) => step.to).join('+'), line.times, line.last.at.slice(17, 19)]);

test('a mission that was offered again and again has one line for it', () => {
  const events = steps('queued requested', ...offers(12), 'offered offered', 'active accepted');
  expect(shape(events)).toEqual([
    ['queued', 1, '00'],
    ['offered+queued', 12, '24'],
    ['offered', 1, '25'],
    ['active', 1, '26'],
  ]);
});

test('steps that came once each stay lines of their own', () => {
  const events = steps('queued requested', 'offered offered', 'queued returned', 'cancelled cancelled');
  expect(shape(events).map(([, times]) => times)).toEqual([1, 1, 1, 1]);
});

test('what a robot recorded several times in a row is one line, and nothing is lost', () => {
  const events = steps('active accepted', 'active recorded', 'active recorded', 'active recorded', 'paused paused', 'active resumed');
  expect(shape(events)).toEqual([
    ['active', 1, '00'],
    ['active', 3, '03'],
    ['paused', 1, '04'],
    ['active', 1, '05'],
  ]);
  const sum = collapsed(events).reduce((count, line) => count + line.times * line.steps.length, 0);
  expect(sum).toBe(events.length);
  expect(collapsed([])).toEqual([]);
});
