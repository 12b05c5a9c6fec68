// Numbers and times for people. What is not known is a dash.
import { roughly } from './eta';
import { preferences } from './preferences.svelte';
import { texts } from './texts';

const cache = new Map<string, Intl.NumberFormat>();

/** Numbers as whoever looks writes them. */
function formatOf(name: string, options: Intl.NumberFormatOptions): Intl.NumberFormat {
  const { locale } = preferences;
  const key = `${locale} ${name}`;
  let format = cache.get(key);
  if (!format) {
    // What rounds to zero has no sign.
    format = new Intl.NumberFormat(locale, { useGrouping: false, signDisplay: 'negative', ...options });
    cache.set(key, format);
  }
  return format;
}

/** A number with a fixed count of digits after the point. */
export function number(value: number | null | undefined, digits: number): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return texts.unknown;
  return formatOf(`${digits}`, { minimumFractionDigits: digits, maximumFractionDigits: digits }).format(value);
}

/** Three significant digits at most, without zeros behind them. */
export function plain(value: number): string {
  return formatOf('plain', { maximumSignificantDigits: 3 }).format(value);
}

/** A number with three significant digits. */
export function short(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return texts.unknown;
  if (value === 0) return '0';
  const digits = Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value))));
  return number(value, Math.min(digits, 6));
}

/** A value with its unit. */
export function unit(value: number | null | undefined, digits: number, name: string): string {
  const text = number(value, digits);
  return text === texts.unknown ? text : `${text} ${name}`;
}

/** A span, as short as it can be read. */
export function span(seconds: number | null | undefined): string {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return texts.unknown;
  const { s, min, h, d } = texts.unit;
  const passed = Math.max(0, seconds);
  if (passed < 10) return `${number(passed, 1)} ${s}`;
  if (passed < 60) return `${number(passed, 0)} ${s}`;
  if (passed < 3600) return `${Math.floor(passed / 60)} ${min} ${number(Math.floor(passed % 60), 0)} ${s}`;
  if (passed < 86_400) return `${Math.floor(passed / 3600)} ${h} ${Math.floor((passed % 3600) / 60)} ${min}`;
  return `${number(passed / 86_400, 1)} ${d}`;
}

/** A span that is an estimate: without its zeros, and no finer than minutes from an hour on. */
export function estimate(seconds: number): string {
  const rough = roughly(seconds);
  const { s, min, h } = texts.unit;
  const [hours, minutes, rest] = [Math.floor(rough / 3600), Math.floor((rough % 3600) / 60), rough % 60];
  const named = [[hours, h], [minutes, min], [rest, s]] as const;
  return named
    .filter(([count]) => count > 0)
    .map(([count, name]) => `${count} ${name}`)
    .join(' ');
}

/** Time of day of a wall time. */
export function clock(at: string | number | Date): string {
  return new Date(at).toLocaleTimeString('en-GB');
}

/** Time of day of a wall time to the minute, with its day unless that is today. */
export function about(at: number, now: number): string {
  const [then, today] = [parts(new Date(at)), parts(new Date(now))];
  const time = then.time.slice(0, -3);
  return then.day === today.day ? time : `${then.day} ${time}`;
}

const two = (value: number) => String(value).padStart(2, '0');

/** Day and time of a wall time, where whoever looks is: `2026-01-31 14:05:09`. */
export function moment(at: string | number | Date): string {
  const { day, time } = parts(new Date(at));
  return `${day} ${time}`;
}

/** The same to the minute, as it is typed: `2026-01-31 14:05`. */
export function minute(at: string | number | Date): string {
  return moment(at).slice(0, -':00'.length);
}

/** What was typed as a moment, where whoever looks is, milliseconds; `NaN` if it is none. Seconds may be left out. */
export function momentOf(text: string): number {
  const found = /^\s*(\d{4})-(\d{1,2})-(\d{1,2})[ T]+(\d{1,2}):(\d{2})(?::(\d{2}))?\s*$/.exec(text);
  if (!found) return NaN;
  const [year = NaN, month = NaN, day = NaN, hour = NaN, min = NaN, s = 0] = found.slice(1).map((part) => (part ? Number(part) : undefined));
  const date = new Date(year, month - 1, day, hour, min, s);
  // A date like the 31st of April would be one of May.
  const isMeant = date.getMonth() === month - 1 && date.getDate() === day && hour < 24 && min < 60 && s < 60;
  return isMeant ? date.getTime() : NaN;
}

/** A moment with its offset from UTC, and the name of the time zone. */
export function exact(at: string | number | Date): string {
  const date = new Date(at);
  const { day, time } = parts(date);
  const east_min = -date.getTimezoneOffset();
  const offset = `${east_min < 0 ? '-' : '+'}${two(Math.floor(Math.abs(east_min) / 60))}:${two(Math.abs(east_min) % 60)}`;
  return `${day}T${time}${offset} (${Intl.DateTimeFormat().resolvedOptions().timeZone})`;
}

function parts(date: Date): { day: string; time: string } {
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return { day, time: `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}` };
}
