import { expect, test } from 'vitest';
import type { Robot } from './api/schema';
import { between, countsOf, groupOf, listed, nameRanks, type Group, type Wanted } from './roster';

interface Made {
  mode?: string;
  link?: string;
  stop?: boolean;
  standstill?: string;
  model?: string;
  name?: string;
  tags?: string[];
}

function robot(id: string, made: Made = {}): Robot {
  return {
    id,
    name: made.name ?? id,
    tags: made.tags ?? [],
    link: made.link ?? 'online',
    model: { name: made.model ?? 'rover', tyres: 'air' },
    live: {
      mode: made.mode ?? 'idle',
      fault: null,
      safety: { stop: made.stop ? { id: 's' } : null, standstill: made.standstill ? { state: made.standstill } : null },
    },
  } as unknown as Robot;
}

const all: Wanted = { search: '', groups: new Set<Group>(), model: null, tag: null, order: 'trouble' };
const ids = (robots: Robot[], wanted: Partial<Wanted>) =>
  listed(robots.map((robot) => ({ robot })), { ...all, ...wanted }, nameRanks(robots)).map((entry) => entry.robot.id);

const fleet = [
  robot('rover-10'),
  robot('rover-9', { mode: 'tracking' }),
  robot('rover-2'),
  robot('rover-3', { mode: 'fault' }),
  robot('rover-4', { link: 'offline', mode: 'fault' }),
  robot('rover-5', { mode: 'stopped', stop: true }),
  robot('rover-6', { mode: 'stopped', stop: true, standstill: 'unexpected_motion' }),
  robot('mule-1', { mode: 'teleoperated', model: 'mule', name: 'Old Betsy' }),
];

test('trouble comes first: fault, lost, stopped, moving, idle, and then as people count', () => {
  expect(ids(fleet, {})).toEqual([
    'rover-3',
    'rover-6',
    'rover-4',
    'rover-5',
    'mule-1',
    'rover-9',
    'rover-2',
    'rover-10',
  ]);
  expect(ids(fleet, { order: 'name' }).slice(0, 3)).toEqual(['mule-1', 'rover-2', 'rover-3']);
});

test('a robot that moves though it is stopped is a fault, and one that nobody hears is lost whatever it said', () => {
  expect(groupOf(robot('a', { mode: 'stopped', standstill: 'standstill_not_reached' }))).toBe('fault');
  expect(groupOf(robot('a', { link: 'offline', mode: 'tracking' }))).toBe('lost');
  expect(groupOf({ ...robot('a'), live: null })).toBe('lost');
  expect(countsOf(fleet)).toEqual({ unconfirmed: 0, fault: 2, lost: 1, stopped: 1, moving: 2, idle: 2 });
});

test('robots whose stop is not confirmed or has failed come before all others, whatever they say of themselves', () => {
  // One says that it is idle, the other is not heard at all.
  const hasStopProblem = (id: string) => id === 'rover-10' || id === 'rover-4';
  const entries = fleet.map((robot) => ({ robot }));
  const order = listed(entries, all, nameRanks(fleet), hasStopProblem).map((entry) => entry.robot.id);
  expect(order.slice(0, 3)).toEqual(['rover-4', 'rover-10', 'rover-3']);
  expect(groupOf(robot('rover-10'), hasStopProblem)).toBe('unconfirmed');
  expect(countsOf(fleet, hasStopProblem)).toEqual({ unconfirmed: 2, fault: 2, lost: 0, stopped: 1, moving: 2, idle: 1 });
  const found = listed(entries, { ...all, groups: new Set<Group>(['unconfirmed']) }, nameRanks(fleet), hasStopProblem);
  expect(found.map((entry) => entry.robot.id)).toEqual(['rover-4', 'rover-10']);
});

test('a search, groups and a model leave what fits all of them', () => {
  expect(ids(fleet, { search: ' BETSY ' })).toEqual(['mule-1']);
  expect(ids(fleet, { search: 'rover 1' })).toEqual(['rover-10']);
  expect(ids(fleet, { groups: new Set<Group>(['stopped', 'lost']) })).toEqual(['rover-4', 'rover-5']);
  expect(ids(fleet, { model: 'mule, air' })).toEqual(['mule-1']);
  expect(ids(fleet, { model: 'mule, air', search: 'rover' })).toEqual([]);
});

test('a range reaches from the first to the last, whichever was chosen first', () => {
  const list = ['a', 'b', 'c', 'd'];
  expect(between(list, 'b', 'd')).toEqual(['b', 'c', 'd']);
  expect(between(list, 'd', 'b')).toEqual(['b', 'c', 'd']);
  expect(between(list, null, 'b')).toEqual(['b']);
  expect(between(list, 'gone', 'b')).toEqual(['b']);
  expect(between(list, 'a', 'gone')).toEqual([]);
});

test('robots are found by their tags, in the search and by choice', () => {
  const tagged = [robot('a', { tags: ['north', 'spare'] }), robot('b', { tags: ['south'] }), robot('c')];
  expect(ids(tagged, { tag: 'spare' })).toEqual(['a']);
  expect(ids(tagged, { search: 'sou' })).toEqual(['b']);
  expect(ids(tagged, { tag: 'east' })).toEqual([]);
  expect(ids(tagged, {})).toEqual(['a', 'b', 'c']);
});
