// The times at which the friction map is looked at: minutes, or ends of hours, days or months. Pure.

export type Span = 'hour' | 'day' | 'week' | 'month';
export const SPANS: readonly Span[] = ['hour', 'day', 'week', 'month'];

const MINUTE_MS = 60_000;
const HOUR_MS = 60 * MINUTE_MS;
const DAY_MS = 24 * HOUR_MS;
/** Length of a span and its steps, milliseconds; days are those of UTC, as the map's are. */
const STEPS: Record<Span, { long_ms: number; step_ms: number }> = {
  hour: { long_ms: HOUR_MS, step_ms: MINUTE_MS },
  day: { long_ms: DAY_MS, step_ms: HOUR_MS },
  week: { long_ms: 7 * DAY_MS, step_ms: HOUR_MS },
  month: { long_ms: 30 * DAY_MS, step_ms: DAY_MS },
};

/** Times of a span up to now, oldest first; each is the end of a minute, an hour or a day. */
export function momentsOf(span: Span, now_ms: number): number[] {
  const { long_ms, step_ms } = STEPS[span];
  // The server's time is known to a second only, and the server says nothing of its future.
  const last_ms = Math.floor((now_ms - MINUTE_MS) / step_ms) * step_ms;
  const count = long_ms / step_ms;
  return Array.from({ length: count + 1 }, (_, index) => last_ms - (count - index) * step_ms);
}

/** The times of the shortest span, from the one that is wanted on, that reaches back to a time; that time is one of them. */
export function momentsWith(at_ms: number, wanted: Span, now_ms: number): { span: Span; moments: number[]; index: number } {
  const reaches = (span: Span) => (momentsOf(span, now_ms)[0] ?? Infinity) <= at_ms;
  const span = SPANS.slice(SPANS.indexOf(wanted)).find(reaches) ?? 'month';
  const moments = [...new Set([...momentsOf(span, now_ms), at_ms])].sort((a, b) => a - b);
  return { span, moments, index: moments.indexOf(at_ms) };
}

/** The steps of a span, seconds. */
export function stepS(span: Span): number {
  return STEPS[span].step_ms / 1000;
}
