import { readFileSync, readdirSync } from 'node:fs';
import { expect, test, vi } from 'vitest';
import { ask } from './api/client';
import { ServerClock, serverClock } from './server_clock';

const TRUE_MS = Date.parse('2026-11-28T12:00:00.400Z');
const HOUR_MS = 3_600_000;

/** A server whose answers take some time, and this machine, whose clock is off. */
function machine(off_ms: number) {
  let passed_ms = 0;
  const clock = new ServerClock(
    () => 5_000 + passed_ms,
    () => TRUE_MS + passed_ms + off_ms,
  );
  const answer = (there_ms: number, back_ms: number) => {
    const sentAt = clock.monotonic();
    passed_ms += there_ms;
    const date = new Date(TRUE_MS + passed_ms).toUTCString();
    passed_ms += back_ms;
    clock.heard(date, { sentAt, answeredAt: clock.monotonic() });
  };
  return { clock, answer, wait: (ms: number) => (passed_ms += ms), error: () => clock.now() - (TRUE_MS + passed_ms) };
}

test('without an answer the clock of this machine counts', () => {
  const { clock, error } = machine(HOUR_MS);
  expect(error()).toBe(HOUR_MS);
  clock.heard(null, { sentAt: 0, answeredAt: 1 });
  clock.heard('no date', { sentAt: 0, answeredAt: 1 });
  expect(error()).toBe(HOUR_MS);
});

test('one answer puts a wrong clock right to about a second, and more of them to less', () => {
  for (const off_ms of [-3 * HOUR_MS, -10_000, 10_000, 24 * HOUR_MS]) {
    const { answer, error, wait } = machine(off_ms);
    answer(20, 30);
    expect(Math.abs(error())).toBeLessThanOrEqual(1_050);
    for (let count = 0; count < 30; count += 1) {
      wait(370);
      answer(20, 30);
    }
    expect(Math.abs(error()), `${off_ms}`).toBeLessThanOrEqual(100);
  }
});

test('a clock that is right is left alone', () => {
  const { answer, error, wait } = machine(0);
  for (let count = 0; count < 30; count += 1) {
    answer(20, 30);
    expect(error()).toBe(0);
    wait(730);
  }
});

test('a slow answer spoils nothing', () => {
  const { answer, error } = machine(HOUR_MS);
  answer(20, 30);
  const before_ms = error();
  answer(9_000, 9_000);
  expect(Math.abs(error())).toBeLessThanOrEqual(Math.abs(before_ms));
});

test('after a clock was set only newer answers count', () => {
  const { clock, answer } = machine(0);
  answer(20, 30);
  // The server's clock was set.
  clock.heard(new Date(TRUE_MS + 2 * HOUR_MS).toUTCString(), { sentAt: clock.monotonic() - 50, answeredAt: clock.monotonic() });
  expect(Math.abs(clock.now() - (TRUE_MS + 2 * HOUR_MS))).toBeLessThanOrEqual(1_050);
});

test('every answer of the server puts the clock right', async () => {
  const at_ms = Date.now() + 5 * HOUR_MS;
  const headers = { date: new Date(at_ms).toUTCString(), 'content-type': 'application/json' };
  vi.stubGlobal('fetch', async () => new Response('{}', { headers }));
  await ask('/readyz');
  vi.unstubAllGlobals();
  expect(Math.abs(serverClock.now() - at_ms)).toBeLessThan(2_000);
});

test('no other source reads the clock of this machine', () => {
  const folder = new URL('./', import.meta.url);
  const files = (readdirSync(folder, { recursive: true }) as string[]).filter(
    (name) => /\.(ts|svelte)$/.test(name) && !/\.test\.ts$|\.d\.ts$/.test(name) && name !== 'server_clock.ts',
  );
  expect(files.length).toBeGreaterThan(80);
  const readers = files.filter((name) => /\bDate\.now\(|\bnew Date\(\)/.test(readFileSync(new URL(name, folder), 'utf8')));
  expect(readers).toEqual([]);
});
