// When missions end and begin: what their cards say, against what came about.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Mission, MissionDetail, Page as ApiPage } from './types';
import { api, browser, eventually, shot } from './harness';

const { open } = browser();
const ROBOT = 'rover-2';
/**
 * How far off the end may be that a card says: seconds, or a share of what was left, whichever is more. What a robot is
 * later than its plan nobody can foresee; on a busy machine it is added.
 */
const MARGIN_S = 10;
const MARGIN_RATIO = 0.25;
/** Time between two looks at a card, milliseconds. */
const LOOK_MS = 2_000;

async function cancelAll(): Promise<void> {
  const openOnes = async () => {
    const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${ROBOT}&limit=100`);
    return items.filter((mission) => !mission.ended_at);
  };
  for (const mission of await openOnes()) await api(`/v1/missions/${mission.id}/cancel`, 'POST').catch(() => undefined);
  await eventually('no open mission', async () => (await openOnes()).length === 0);
}

const send = (turns: number) =>
  api<Mission>('/v1/missions', 'POST', {
    site: 'yard',
    robot: ROBOT,
    trajectory: { circle: { center: { x_m: 8, y_m: 16 }, radius_m: 2, speed_m_s: 0.6, turns } },
  });

const cardOf = (page: Page, mission: Mission) => page.locator(`[data-mission="${mission.id}"]`);
const etaOf = (page: Page, mission: Mission) => cardOf(page, mission).locator('[data-test="eta"]');

/** Seconds in `2 min 10 s`. */
function secondsOf(text: string): number {
  const found = /about (?:(\d+) h ?)?(?:(\d+) min ?)?(?:(\d+) s)?(?: left|,)/.exec(text);
  if (!found) throw new Error(`no time in \`${text}\``);
  return Number(found[1] ?? 0) * 3600 + Number(found[2] ?? 0) * 60 + Number(found[3] ?? 0);
}

test('a card counts down to the end of its mission, and the next one begins then', async () => {
  await cancelAll();
  const page = await open();
  await page.getByRole('tab', { name: 'Missions' }).click();
  const [first, second] = [await send(2), await send(0.3)];
  const driving = etaOf(page, first);
  await driving.getByText(/^about .* left, ends at about \d\d:\d\d$/).waitFor();
  const waiting = etaOf(page, second);
  await waiting.getByText(/^starts in about .*, at about \d\d:\d\d$/).waitFor();
  await shot(page, 'eta');
  /** What was said, and when, seconds. */
  const said: { at_s: number; left_s: number; starts_s: number | null }[] = [];
  while (await driving.isVisible()) {
    const [left, starts] = [await driving.allInnerTexts(), await waiting.allInnerTexts()];
    if (!left[0]) break;
    said.push({ at_s: Date.now() / 1000, left_s: secondsOf(left[0]), starts_s: starts[0] ? secondsOf(starts[0]) : null });
    await page.waitForTimeout(LOOK_MS);
  }
  const detail = (mission: Mission) => api<MissionDetail>(`/v1/missions/${mission.id}`);
  const ended = await eventually('the end', async () => {
    const mission = await detail(first);
    return mission.ended_at ? mission : null;
  });
  expect(ended.state).toBe('succeeded');
  const begun = await eventually('the next one begins', async () => {
    const mission = await detail(second);
    return mission.started_at ? mission : null;
  });
  expect(said.length).toBeGreaterThan(5);
  const end_s = Date.parse(ended.ended_at ?? '') / 1000;
  const begin_s = Date.parse(begun.started_at ?? '') / 1000;
  const lasted_s = end_s - Date.parse(ended.started_at ?? '') / 1000;
  const late_s = Math.abs(lasted_s - (ended.plan?.duration_s ?? NaN));
  const off = (at_s: number, wait_s: number, truth_s: number) =>
    Math.abs(at_s + wait_s - truth_s) - Math.max(MARGIN_S, MARGIN_RATIO * (truth_s - at_s)) - late_s;
  for (const { at_s, left_s, starts_s } of said) {
    const story = `${left_s} s left were said ${(end_s - at_s).toFixed(1)} s before the end, ${late_s.toFixed(1)} s late`;
    expect(off(at_s, left_s, end_s), story).toBeLessThan(0);
    if (starts_s !== null) expect(off(at_s, starts_s, begin_s), `next one: ${story}`).toBeLessThan(0);
  }
  // It counts down: never up by more than it is rounded to.
  const ups = said.filter(({ left_s }, index) => left_s > (said[index - 1]?.left_s ?? Infinity) + 10);
  expect(ups).toEqual([]);
  expect(said[0]?.left_s).toBeGreaterThan((said.at(-1)?.left_s ?? Infinity) + 15);
  await cancelAll();
}, 180_000);

test('nothing is said of a mission that is paused, nor of what waits for it', async () => {
  await cancelAll();
  const page = await open();
  await page.getByRole('tab', { name: 'Missions' }).click();
  const [first, second] = [await send(3), await send(1)];
  await etaOf(page, first).waitFor();
  await etaOf(page, second).waitFor();
  await cardOf(page, first).getByRole('button', { name: 'Pause' }).click();
  await cardOf(page, first).getByText('paused', { exact: true }).waitFor();
  await etaOf(page, first).waitFor({ state: 'detached' });
  await etaOf(page, second).waitFor({ state: 'detached' });
  await cardOf(page, first).getByRole('button', { name: 'Resume' }).click();
  await etaOf(page, first).waitFor();
  // The same in the card of the one that is opened.
  await cardOf(page, first).getByRole('button', { name: 'Show' }).click();
  await page.locator('[data-test="detail"] [data-test="eta"]').waitFor();
  await cancelAll();
});

test('a plan that comes after its mission has begun is asked for', async () => {
  await cancelAll();
  const page = await open({
    async prepare(page) {
      // The events of a robot that was quicker than the server's own answer.
      await page.addInitScript(() => {
        const parse = JSON.parse.bind(JSON);
        JSON.parse = (text: string, ...more) => {
          const read = parse(text, ...more) as { mission?: { plan?: unknown } } | null;
          if (read?.mission?.plan) read.mission.plan = null;
          return read;
        };
      });
    },
  });
  await page.getByRole('tab', { name: 'Missions' }).click();
  const sent = await send(2);
  await etaOf(page, sent).waitFor();
  await cancelAll();
});
