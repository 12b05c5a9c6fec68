// Which robots of a fleet are listed, in which order, and which a choice means. Pure.
import type { Robot } from './api/schema';
import { doing, hasFault } from './standstill';

/**
 * What a robot is up to, as far as it concerns whoever supervises it: trouble first, and first of all robots that are
 * to stop and have not confirmed it, or whose stop failed.
 */
export const GROUPS = ['unconfirmed', 'fault', 'lost', 'stopped', 'moving', 'idle'] as const;
export type Group = (typeof GROUPS)[number];
export type Order = 'trouble' | 'name';

/** What robots are looked for; no groups, no model and no tag mean all. */
export interface Wanted {
  search: string;
  groups: ReadonlySet<Group>;
  model: string | null;
  tag: string | null;
  order: Order;
}

/** Whether something is wrong with the stop of a robot: it is not confirmed, or it failed. */
export type HasStopProblem = (robot: string) => boolean;
const NONE: HasStopProblem = () => false;

export function groupOf(robot: Robot, hasStopProblem: HasStopProblem = NONE): Group {
  const { live } = robot;
  // It may drive on, whatever else is known of it.
  if (hasStopProblem(robot.id)) return 'unconfirmed';
  // Whatever a robot said last, nobody knows whether it still is so.
  if (robot.link === 'offline' || !live) return 'lost';
  if (hasFault(live) || doing(live).isBad) return 'fault';
  if (live.mode === 'stopped' || live.safety.stop) return 'stopped';
  return live.mode === 'idle' ? 'idle' : 'moving';
}

/** The name of a robot's model with its tyres, by which fleets are sorted out. */
export function modelOf({ model }: Robot): string {
  return `${model.name}, ${model.tyres}`;
}

const byName = new Intl.Collator('en', { numeric: true });

/** Robots by name, as people count: 2 before 10. */
export function compareNames(a: Robot, b: Robot): number {
  return byName.compare(a.name, b.name) || byName.compare(a.id, b.id);
}

/** Whether each word of a search is in a robot's name, identifier or tags. */
function isFound(robot: Robot, words: readonly string[]): boolean {
  if (words.length === 0) return true;
  const text = [robot.name, robot.id, ...(robot.tags ?? [])].join(' ').toLowerCase();
  return words.every((word) => text.includes(word));
}

/** The place of each robot in the order of names. */
export type NameRanks = ReadonlyMap<string, number>;

export function nameRanks(robots: Iterable<Robot>): NameRanks {
  return new Map([...robots].sort(compareNames).map((robot, rank) => [robot.id, rank]));
}

/** The robots that are wanted, in the order that is wanted. Names are ranked beforehand: they change seldom. */
export function listed<Entry extends { robot: Robot }>(
  entries: readonly Entry[],
  wanted: Wanted,
  ranks: NameRanks,
  hasStopProblem: HasStopProblem = NONE,
): Entry[] {
  const words = wanted.search.toLowerCase().split(/\s+/).filter(Boolean);
  const found = entries
    .map((entry) => ({ entry, rank: GROUPS.indexOf(groupOf(entry.robot, hasStopProblem)) }))
    .filter(
      ({ entry: { robot }, rank }) =>
        isFound(robot, words) &&
        (wanted.groups.size === 0 || wanted.groups.has(GROUPS[rank] ?? 'idle')) &&
        (wanted.model === null || modelOf(robot) === wanted.model) &&
        (wanted.tag === null || (robot.tags ?? []).includes(wanted.tag)),
    );
  const isByTrouble = wanted.order === 'trouble';
  const rankOf = ({ robot }: Entry) => ranks.get(robot.id) ?? ranks.size;
  found.sort((a, b) => (isByTrouble ? a.rank - b.rank : 0) || rankOf(a.entry) - rankOf(b.entry));
  return found.map(({ entry }) => entry);
}

/** How many robots each group has. */
export function countsOf(robots: Iterable<Robot>, hasStopProblem: HasStopProblem = NONE): Record<Group, number> {
  const counts: Record<Group, number> = { unconfirmed: 0, fault: 0, lost: 0, stopped: 0, moving: 0, idle: 0 };
  for (const robot of robots) counts[groupOf(robot, hasStopProblem)] += 1;
  return counts;
}

/** What lies between two of a list, both included; the second alone if the first is not there. */
export function between(ids: readonly string[], from: string | null, to: string): string[] {
  const end = ids.indexOf(to);
  const begin = from === null ? -1 : ids.indexOf(from);
  if (end < 0) return [];
  return begin < 0 ? [to] : ids.slice(Math.min(begin, end), Math.max(begin, end) + 1);
}
