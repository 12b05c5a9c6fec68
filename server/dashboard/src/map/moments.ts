// The times at which the friction map can be had: ends of hours, or of days. Pure.

export type Span = 'day' | 'week' | 'month';
export const SPANS: readonly Span[] = ['day', 'week', 'month'];

const HOUR_MS = 3_600_000;
const DAY_MS = 24 * HOUR_MS;
/** Length of a span and its steps, milliseconds; the map knows hours for a week, days (UTC) beyond. */
const STEPS: Record<Span, { long_ms: number; step_ms: number }> = {
  day: { long_ms: DAY_MS, step_ms: HOUR_MS },
  week: { long_ms: 7 * DAY_MS, step_ms: HOUR_MS },
  month: { long_ms: 30 * DAY_MS, step_ms: DAY_MS },
};
/** Times of the history of a cell: each one is a request. */
const CELL_TIMES_MAX = 25;

/** Times of a span up to now, oldest first; each is the end of an hour or day. */
export function momentsOf(span: Span, now_ms: number): number[] {
  const { long_ms, step_ms } = STEPS[span];
  const last_ms = Math.floor(now_ms / step_ms) * step_ms;
  const count = long_ms / step_ms;
  return Array.from({ length: count + 1 }, (_, index) => last_ms - (count - index) * step_ms);
}

/** Fewer times, evenly, with the first and the last. */
export function thinned(moments: readonly number[], most = CELL_TIMES_MAX): number[] {
  if (moments.length <= most) return [...moments];
  return Array.from({ length: most }, (_, index) => {
    const at = Math.round((index * (moments.length - 1)) / (most - 1));
    return moments[at] ?? NaN;
  });
}

/** The steps of a span, seconds. */
export function stepS(span: Span): number {
  return STEPS[span].step_ms / 1000;
}
