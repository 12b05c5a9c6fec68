// The first steps, from the sign-in to friction on the map, as somebody takes them who is here for the first time.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { CellFriction, CreatedToken, Mission, Page as ApiPage } from './types';
import { violations } from './checks';
import { crowd } from './crowd';
import { api, browser, eventually, map, shot, token, windowOf } from './harness';
import { ownServer } from './own_server';

const { open } = browser();
const NEW = { 'tread-guide': null } as const;
/** How long a mission may take to begin and to measure, milliseconds. */
const MEASURED_MS = 90_000;

/** Time in which the map and the address show what is wanted, milliseconds. */
const SHOWN_MS = 1_500;

const guideOf = (page: Page) => page.locator('[data-test="guide"]');
const stepOf = (page: Page, step: string, isDone: boolean) => guideOf(page).locator(`[data-step="${step}"][data-done="${isDone}"]`);

/** Commands of which a part is out of sight. */
const clipped = (page: Page) =>
  guideOf(page)
    .locator('pre, pre code')
    .evaluateAll((all) => {
      const isOut = (one: Element) => {
        const edge = one.closest('[data-test="guide"]')?.getBoundingClientRect().right ?? 0;
        return one.scrollWidth > one.clientWidth + 1 || one.getBoundingClientRect().right > edge;
      };
      return all.filter(isOut).map((one) => one.textContent);
    });

async function newest(robot: string): Promise<Mission | undefined> {
  return (await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=1`)).items[0];
}

async function endAll(robot: string): Promise<void> {
  const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=100`);
  for (const mission of items) {
    if (!mission.ended_at) await api(`/v1/missions/${mission.id}/cancel`, 'POST').catch(() => undefined);
  }
}

/** Waits for friction; where the circle shows none, does what the guide says then. */
async function measured(page: Page): Promise<void> {
  const done = stepOf(page, 'friction', true);
  const unmeasured = guideOf(page).getByText('Nothing was measured yet');
  await done.or(unmeasured).first().waitFor({ timeout: MEASURED_MS });
  if (await done.isVisible()) return;
  const mission = await newest('rover-1');
  const robot = await api<unknown>('/v1/sites/yard/robots/rover-1');
  console.log('the circle showed no friction:', JSON.stringify(mission), JSON.stringify(robot));
  await endAll('rover-1');
  const points = [[7, 5], [9, 5.5], [7, 6], [9, 6.5], [7, 7], [9, 5]].map(([x_m, y_m]) => ({ x_m, y_m }));
  await api('/v1/missions', 'POST', { site: 'yard', robot: 'rover-1', trajectory: { waypoints: { points, speed_m_s: 0.5 } } });
  await done.waitFor({ timeout: MEASURED_MS });
}

for (const [name, size, theme] of [
  ['wide', { width: 1360, height: 850 }, 'light'],
  ['phone', { width: 390, height: 800 }, 'dark'],
] as const) {
  test(`three steps from the sign-in to friction on the map: ${name}`, async () => {
    const page = await open({ size, theme, kept: NEW, as: null });
    await page.getByLabel('Token').fill(token());
    await page.getByRole('button', { name: 'Sign in' }).click();
    // On a phone the steps are behind a line.
    const unfold = async () => {
      const line = guideOf(page).locator('summary');
      await guideOf(page).waitFor();
      if (await line.isVisible()) await line.click();
    };
    await unfold();
    // A robot of the demo is online: the first step has ticked itself.
    await stepOf(page, 'robot', true).waitFor();
    await stepOf(page, 'mission', false).waitFor();
    expect(await guideOf(page).locator('[aria-current="step"]').getAttribute('data-step')).toBe('mission');
    expect(await violations(page)).toEqual([]);
    await shot(page, `guide-${name}-mission`);
    await page.locator('button[data-robot="rover-1"]').click();
    await endAll('rover-1');
    await guideOf(page).getByRole('button', { name: 'Draw a mission' }).click();
    await guideOf(page).getByText('then press Send').waitFor();
    const circle = { 'Centre x, m': '8', 'Centre y, m': '6', 'Radius, m': '1.5' };
    for (const [label, value] of Object.entries(circle)) {
      await page.getByLabel(label).fill(value);
      await page.getByLabel(label).press('Tab');
    }
    await page.locator('[data-test="dry-run"]').waitFor();
    await page.getByText('The dry run is under way').waitFor({ state: 'hidden' });
    expect(await violations(page)).toEqual([]);
    await shot(page, `guide-${name}-draw`);
    await page.getByRole('button', { name: 'Send', exact: true }).click();
    await stepOf(page, 'mission', true).waitFor();
    await shot(page, `guide-${name}-driving`);
    // A reload on the way loses nothing.
    await page.reload();
    await unfold();
    await stepOf(page, 'mission', true).waitFor();
    await measured(page);
    await guideOf(page).getByText('All done').first().waitFor();
    expect(await violations(page)).toEqual([]);
    await shot(page, `guide-${name}-done`);
    await guideOf(page).getByRole('button', { name: 'Show it on the map' }).click();
    await page.waitForTimeout(SHOWN_MS);
    const [x_m = NaN, y_m = NaN] = /view=(-?[\d.]+),(-?[\d.]+)/.exec(page.url())?.slice(1).map(Number) ?? [];
    expect(Math.hypot(x_m - 8, y_m - 6), page.url()).toBeLessThan(8);
    expect(page.url()).toContain('layer=theta');
    if (name === 'wide') {
      // What was measured since is in sight, with its value.
      const sent = await newest('rover-1');
      const box = await map(page);
      const place = await windowOf(page);
      await eventually('the friction of the mission', async () => {
        const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
        for (const { cell, size_m, friction } of items) {
          const at = place((cell.ix + 0.5) * size_m, (cell.iy + 0.5) * size_m);
          // What lies under the box of layers cannot be pointed at.
          const isSeen = at.x > box.x && at.x < box.x + box.width - 280 && at.y > box.y + 60 && at.y < box.y + box.height - 40;
          if (!isSeen || Date.parse(friction.newest_at) < Date.parse(sent?.started_at ?? '')) continue;
          await page.mouse.move(at.x, at.y);
          return /Slip \(θ\) [\d.]+/.test(await page.locator('output.cursor').innerText());
        }
        return false;
      });
    }
    await shot(page, `guide-${name}-friction`);
    await guideOf(page).getByRole('button', { name: 'Close' }).click();
    await guideOf(page).waitFor({ state: 'detached' });
    await page.reload();
    await page.locator('button[data-robot], #panel h2').first().waitFor();
    expect(await guideOf(page).count()).toBe(0);
    await endAll('rover-1');
  }, 300_000);
}

test('after a mission that measured nothing, another one is advised', async () => {
  await endAll('rover-1');
  const trajectory = { circle: { center: { x_m: 8, y_m: 6 }, radius_m: 1.5, speed_m_s: 0.5 } };
  const { id } = await api<Mission>('/v1/missions', 'POST', { site: 'yard', robot: 'rover-1', trajectory });
  await eventually('the mission begins', async () => (await newest('rover-1'))?.started_at);
  await endAll('rover-1');
  const sent = JSON.stringify({ id, site: 'yard', robot: 'rover-1' });
  const asked: number[] = [];
  const page = await open({
    kept: { 'tread-guide': 'open' },
    prepare: async (page) => {
      await page.addInitScript((kept) => localStorage.setItem('tread-sent', kept), sent);
      await page.route('**/friction/cells?*', (route) => route.fulfill({ json: { items: [] } }));
      page.on('request', (request) => {
        if (request.url().endsWith(`/missions/${id}/path`)) asked.push(Date.now());
      });
    },
  });
  await stepOf(page, 'mission', true).waitFor();
  await guideOf(page).getByText('Send a path with straight parts').waitFor();
  // However often robots say something, it looks every two seconds.
  expect(asked.length).toBeLessThanOrEqual(4);
  expect((asked[1] ?? 0) - (asked[0] ?? 0)).toBeGreaterThan(1_000);
  expect(await violations(page)).toEqual([]);
  await shot(page, 'guide-unmeasured');
  await guideOf(page).getByRole('button', { name: 'Draw a mission' }).click();
  await guideOf(page).getByText('Set points of a path').waitFor();
});

test('it can be closed, stays closed, and is opened again from the settings', async () => {
  const page = await open({ kept: NEW });
  await guideOf(page).waitFor();
  await guideOf(page).getByRole('button', { name: 'Close' }).click();
  await page.reload();
  await page.locator('button[data-robot]').first().waitFor();
  expect(await guideOf(page).count()).toBe(0);
  await page.getByRole('button', { name: 'Settings' }).click();
  await page.getByRole('button', { name: 'Show the first steps' }).click();
  await stepOf(page, 'robot', true).waitFor();
  await page.reload();
  await guideOf(page).waitFor();
});

/** Lets the server of the demo say that robots can join. */
async function joinable(page: Page): Promise<void> {
  await page.route('**/v1/server', async (route) => {
    const answer = await route.fetch();
    await route.fulfill({ response: answer, json: { ...((await answer.json()) as object), robots_can_join: true } });
  });
}

test('a server without [robots] shows what to add instead of commands that it would refuse', async () => {
  const own = await ownServer();
  try {
    const page = await open({ kept: NEW, as: null, address: `${own.address}/#site=yard` });
    await page.getByLabel('Token').fill(own.token);
    await page.getByRole('button', { name: 'Sign in' }).click();
    await stepOf(page, 'robot', false).getByText('add [robots] to its configuration').waitFor();
    expect(await guideOf(page).locator('pre').count()).toBe(0);
    expect(await violations(page)).toEqual([]);
    await shot(page, 'guide-closed');
    await page.close();
  } finally {
    await own.end();
  }
});

test('an empty fleet is shown how a robot joins, with commands to copy', async () => {
  const sent = JSON.stringify({ id: 'before', site: 'yard', robot: 'rover-1' });
  const prepare = async (page: Page) => {
    await page.context().grantPermissions(['clipboard-read', 'clipboard-write']);
    await page.addInitScript((kept) => localStorage.setItem('tread-sent', kept), sent);
    await crowd(page, 0);
    await joinable(page);
  };
  const enter = async (page: Page, secret: string) => {
    await page.getByLabel('Token').fill(secret);
    await page.getByRole('button', { name: 'Sign in' }).click();
    await guideOf(page).waitFor();
  };
  const page = await open({ kept: NEW, as: null, prepare });
  await enter(page, token());
  await stepOf(page, 'robot', false).waitFor();
  const commands = await page.getByRole('region', { name: 'Commands for a robot to join' }).innerText();
  expect(commands).toContain('tread robots join-token --site yard');
  expect(await violations(page)).toEqual([]);
  await page.getByRole('button', { name: 'Copy' }).click();
  await page.getByText('Copied.').waitFor();
  expect((await page.evaluate(() => navigator.clipboard.readText())).trim()).toBe(commands.trim());
  expect(await clipped(page)).toEqual([]);
  await shot(page, 'guide-enrol');
  // Who may not let robots join is not shown how.
  const operator = await api<CreatedToken>('/v1/tokens', 'POST', { name: `operator ${Date.now()}`, role: 'operator' });
  const other = await open({ kept: NEW, as: null, prepare });
  await enter(other, operator.secret);
  await other.getByText('Whoever administers this server lets robots join.').waitFor();
  expect(await guideOf(other).locator('pre').count()).toBe(0);
});

test('the first steps are German where the page is', async () => {
  const prepare = async (page: Page) => {
    await crowd(page, 0);
    await joinable(page);
  };
  const page = await open({ kept: NEW, as: null, locale: 'de-DE', prepare });
  await page.locator('input[name="token"]').fill(token());
  await page.getByRole('button', { name: 'Anmelden' }).click();
  await guideOf(page).getByText('Nehmen Sie einen Roboter auf').waitFor();
  expect(await violations(page)).toEqual([]);
  expect(await clipped(page)).toEqual([]);
  await guideOf(page).getByRole('button', { name: 'Kopieren' }).waitFor();
  await shot(page, 'guide-enrol-de');
});

test('a viewer, who can send nothing, is shown no first steps', async () => {
  const viewer = await api<CreatedToken>('/v1/tokens', 'POST', { name: `viewer ${Date.now()}`, role: 'viewer' });
  const page = await open({ kept: NEW, as: viewer.secret });
  await page.getByRole('button', { name: 'Settings' }).click();
  await page.locator('#settings').waitFor();
  expect(await page.getByRole('button', { name: 'Show the first steps' }).count()).toBe(0);
  expect(await guideOf(page).count()).toBe(0);
});
