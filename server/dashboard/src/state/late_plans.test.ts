import { afterEach, beforeEach, expect, test, vi } from 'vitest';
import type { Mission } from '../api/schema';
import { LatePlans } from './late_plans';

const PLAN = { length_m: 10, duration_s: 20, speed_peak_m_s: 0.5 };
const bare = { id: 'm-1', state: 'active', revision: 1, plan: null } as unknown as Mission;
let known: Mission | undefined;
let asked = 0;

/** A server that has the plan from so many questions on. */
function server(from: number, revision = 1): LatePlans {
  asked = 0;
  known = bare;
  vi.stubGlobal('fetch', async () => {
    asked += 1;
    return new Response(JSON.stringify({ ...bare, revision, plan: asked >= from ? PLAN : null }));
  });
  return new LatePlans(
    () => known,
    (mission) => (known = mission),
  );
}

beforeEach(() => void vi.useFakeTimers());
afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

test('a mission that began without a plan is read until it has one', async () => {
  server(3).look(bare);
  await vi.advanceTimersByTimeAsync(60_000);
  expect([asked, known?.plan]).toEqual([3, PLAN]);
});

test('it is not read for ever, nor where there is nothing to wait for', async () => {
  server(Infinity).look(bare);
  await vi.advanceTimersByTimeAsync(600_000);
  expect([asked, known?.plan]).toEqual([5, null]);
  const plans = server(1);
  plans.look({ ...bare, state: 'queued' });
  plans.look({ ...bare, plan: PLAN });
  await vi.advanceTimersByTimeAsync(60_000);
  expect(asked).toBe(0);
});

test('the plan of another revision is not taken', async () => {
  server(1, 2).look(bare);
  await vi.advanceTimersByTimeAsync(600_000);
  expect(known?.plan).toBeNull();
});
