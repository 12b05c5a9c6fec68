// A mission's history for people: what repeats is one line. Pure.
import type { MissionEvent } from './api/schema';

/** Steps that follow each other again and again: being offered, being given back. */
const PERIODS = [1, 2];

/** One line of a history: its steps, and how often they came in this order. */
export interface HistoryLine {
  /** The steps of the first time. */
  steps: MissionEvent[];
  times: number;
  /** The last step of the last time. */
  last: MissionEvent;
}

const kind = ({ to, cause }: MissionEvent) => `${to} ${cause}`;

/** How often the steps from `begin` on come in the same order, `period` of them each time. */
function repeats(events: readonly MissionEvent[], begin: number, period: number): number {
  let index = begin;
  while (true) {
    const event = events[index];
    const model = events[begin + ((index - begin) % period)];
    if (!event || !model || kind(event) !== kind(model)) break;
    index += 1;
  }
  return Math.floor((index - begin) / period);
}

/** A history in which steps that repeat are one line. */
export function collapsed(events: readonly MissionEvent[]): HistoryLine[] {
  const lines: HistoryLine[] = [];
  let index = 0;
  while (index < events.length) {
    const period = PERIODS.find((length) => repeats(events, index, length) > 1) ?? 1;
    const times = repeats(events, index, period);
    const end = index + period * times;
    const last = events[end - 1];
    if (!last) break;
    lines.push({ steps: events.slice(index, index + period), times, last });
    index = end;
  }
  return lines;
}
