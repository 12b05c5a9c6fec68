// Small things that are in the way every day: where the focus is, what a view returns to, and words.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Mission, MissionDetail, Page as ApiPage } from './types';
import { overflowing } from './checks';
import { api, browser, eventually, map, metresAt, select, shot } from './harness';

const { open } = browser();

/** What has the focus, in a word. */
const focused = (page: Page) =>
  page.evaluate(() => {
    const at = document.activeElement;
    return at === document.body || !at ? 'body' : `${at.tagName.toLowerCase()} ${at.textContent?.trim().slice(0, 20) ?? ''}`;
  });

for (const [name, size] of [
  ['wide', { width: 1360, height: 850 }],
  ['tablet', { width: 820, height: 1180 }],
  ['phone', { width: 360, height: 740 }],
] as const) {
  test(`options stay within their panel: ${name}`, async () => {
    const page = await open({ size });
    await select(page, 'rover-3');
    await page.getByRole('button', { name: 'New mission' }).click();
    await page.getByRole('radio', { name: 'Waypoints' }).check();
    await page.getByRole('button', { name: 'Add point' }).click();
    await page.getByText('Options').click();
    await page.getByLabel('If the robot has other missions').scrollIntoViewIfNeeded();
    expect(await overflowing(page)).toEqual([]);
    await shot(page, `options-${name}`);
  });
}

test('the focus goes on where the robot is that was chosen, and back to where it was', async () => {
  const page = await open();
  await page.locator('button[data-robot="rover-2"]').focus();
  await page.keyboard.press('Enter');
  await page.getByRole('button', { name: 'All robots' }).waitFor();
  await eventually('the focus on the robot', async () => (await focused(page)) === 'h2 rover-2');
  await page.getByRole('button', { name: 'All robots' }).focus();
  await page.keyboard.press('Enter');
  await page.locator('button[data-robot="rover-2"]').waitFor();
  await eventually('the focus in the list', async () => (await focused(page)).startsWith('button rover-2'));
  // The same of what is drawn and discarded.
  await page.keyboard.press('Enter');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('button', { name: 'Discard' }).click();
  await eventually('the focus in the panel', async () => (await focused(page)) === 'h2 rover-2');
});

test('a mission that is closed leaves the map as it was, unless it was moved meanwhile', async () => {
  const ended = await eventually('a mission that has ended', async () => {
    const { items } = await api<ApiPage<Mission>>('/v1/missions?site=yard&limit=100');
    return items.find((mission) => mission.state === 'succeeded');
  }, 60_000);
  const page = await open();
  const box = await map(page);
  const corner = () => metresAt(page, box.x + 20, box.y + 120);
  for (let step = 0; step < 3; step += 1) await page.getByRole('button', { name: 'Zoom out' }).click();
  const before = await corner();
  await page.getByRole('tab', { name: 'Missions' }).click();
  const row = page.locator('.ended button', { hasText: ended.robot }).first();
  await row.click();
  await page.locator('[data-test="detail"]').waitFor();
  await eventually('another part of the map', async () => Math.abs((await corner()).x_m - before.x_m) > 0.5);
  await page.getByRole('button', { name: 'Close', exact: true }).click();
  await eventually('the map as it was', async () => {
    const now = await corner();
    return now.x_m === before.x_m && now.y_m === before.y_m;
  });
  await row.click();
  await page.locator('[data-test="detail"]').waitFor();
  await page.getByRole('button', { name: 'Zoom in' }).click();
  const moved = await corner();
  await page.getByRole('button', { name: 'Close', exact: true }).click();
  await page.locator('[data-test="detail"]').waitFor({ state: 'detached' });
  expect(await corner()).toEqual(moved);
});

test('repeated steps of a history are one line, and times have one format', async () => {
  const { items } = await api<ApiPage<Mission>>('/v1/missions?site=yard&limit=100');
  const mission = items.find((known) => known.ended_at);
  if (!mission) throw new Error('no mission has ended');
  const page = await open({
    async prepare(page) {
      await page.route(/\/v1\/missions\/[0-9a-f-]{36}$/, async (route) => {
        const response = await route.fetch();
        const detail = (await response.json()) as MissionDetail;
        const [first, last] = [detail.events[0], detail.events.at(-1)];
        if (!first || !last) throw new Error('there is no history');
        // A robot that gave it back a dozen times before it took it.
        const offers = Array.from({ length: 12 }, () => [
          { ...first, from: 'queued', to: 'offered', cause: 'offered', reason: null },
          { ...first, from: 'offered', to: 'queued', cause: 'returned', reason: 'the robot is stopped' },
        ]).flat();
        await route.fulfill({ response, json: { ...detail, events: [first, ...offers, last] } });
      });
    },
  });
  await page.getByRole('tab', { name: 'Missions' }).click();
  await page.locator('.ended button').first().waitFor();
  const rows = page.locator('.ended button');
  await rows.first().click();
  const line = page.locator('.events li', { hasText: 'offered 12 times' });
  await line.getByText('the robot is stopped').waitFor();
  // The two dozen steps of the robot that gave it back are one line, between the first step and the last.
  expect(await page.locator('.events li').count()).toBe(3);
  const format = /^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d$/;
  for (const time of await page.locator('time').all()) {
    expect(await time.innerText()).toMatch(format);
    expect(await time.getAttribute('title')).toMatch(/[+-]\d\d:\d\d \(.+\)$/);
  }
  await line.scrollIntoViewIfNeeded();
  await shot(page, 'collapsed-history');
});

test('what cannot be saved or sent yet says why, beside the button', async () => {
  const page = await open();
  const why = page.locator('#why-not');
  await page.getByRole('tab', { name: 'Terrains' }).click();
  await page.getByRole('button', { name: 'New terrain' }).click();
  expect(await why.innerText()).toBe('Not yet: an area needs three corners, 0 so far.');
  expect(await page.getByRole('button', { name: 'Save' }).isDisabled()).toBe(true);
  for (let corner = 0; corner < 3; corner += 1) await page.getByRole('button', { name: 'Add point' }).click();
  expect(await why.innerText()).toBe('Not yet: enter an identifier.');
  await page.getByLabel('Identifier').fill('a-place');
  await why.waitFor({ state: 'detached' });
  expect(await page.getByRole('button', { name: 'Save' }).isEnabled()).toBe(true);
  await page.getByRole('button', { name: 'Discard' }).click();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  expect(await why.innerText()).toBe('Not yet: drag a circle on the map, or enter its centre.');
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  await page.getByRole('button', { name: 'Add point' }).click();
  expect(await why.innerText()).toBe('Not yet: a path needs two points, 1 so far.');
  await shot(page, 'why-not');
});

test('a wrong token is said without a word of HTTP', async () => {
  const page = await open({ as: null, expected: /401/ });
  await page.getByLabel('Token').fill('tread_a_wrong');
  await page.getByRole('button', { name: 'Sign in' }).click();
  const said = await page.getByRole('alert').innerText();
  expect(said).toMatch(/token.*mistyped, expired or revoked/);
  expect(said).not.toMatch(/bearer|header|authori[sz]ation|\/v1/i);
  await shot(page, 'wrong-token');
});

test('fingers are shown what fingers do: a long press deletes a point', async () => {
  const page = await open({ size: { width: 390, height: 800 }, hasTouch: true });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  const form = page.locator('form');
  await form.getByText('long-press it to delete it').waitFor();
  expect(await form.innerText()).not.toMatch(/right-click|click/i);
  await page.evaluate(() => scrollTo(0, 0));
  const box = await map(page);
  const at = { x: box.x + 120, y: box.y + box.height - 90 };
  const touch = await page.context().newCDPSession(page);
  const inputs = page.getByLabel(/^Point \d+, x/);
  await page.touchscreen.tap(at.x, at.y);
  await page.touchscreen.tap(at.x + 90, at.y);
  expect(await inputs.count()).toBe(2);
  await touch.send('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: [at] });
  await eventually('the point is gone', async () => (await inputs.count()) === 1);
  await touch.send('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
  expect(await inputs.count()).toBe(1);
  await page.getByRole('button', { name: 'Undo' }).click();
  expect(await inputs.count()).toBe(2);
});

test('why nothing can be stopped is written beside the button, not only behind it', async () => {
  const page = await open();
  const why = page.getByText('Select robots on the map or in the list to stop these alone.');
  await why.waitFor();
  const button = page.getByRole('button', { name: 'Stop robot', exact: true });
  expect(await button.isDisabled()).toBe(true);
  expect(await button.getAttribute('aria-describedby')).toBe(await why.getAttribute('id'));
  await select(page, 'rover-2');
  await why.waitFor({ state: 'detached' });
});

test('the legend of a mission says what the map draws: lines while it is driven, dashes once it is over', async () => {
  const circle = { center: { x_m: 8, y_m: 16 }, radius_m: 3, speed_m_s: 0.4, turns: 20 };
  const sent = await api<Mission>('/v1/missions', 'POST', { site: 'yard', robot: 'rover-2', trajectory: { circle }, start_policy: 'replace' });
  await eventually('it is driven', async () => (await api<Mission>(`/v1/missions/${sent.id}`)).state === 'active');
  const page = await open();
  await page.getByRole('tab', { name: 'Missions' }).click();
  await page.locator(`[data-mission="${sent.id}"]`).getByRole('button', { name: 'Show' }).click();
  const legend = page.locator('[data-test="detail"] .legend');
  await legend.getByText('approach').waitFor();
  /** Length of the dashes of a line, pixels; 0 for none. */
  const dashOf = async (name: string) => {
    const line = legend.locator('span', { hasText: name }).locator('line');
    return Number((await line.getAttribute('stroke-dasharray'))?.split(' ')[0] ?? 0);
  };
  expect(await dashOf('approach')).toBeGreaterThan(0);
  expect(await dashOf('planned')).toBe(0);
  await shot(page, 'legend');
  // Sending another one in its place asks once more, since that ends it.
  await page.getByRole('button', { name: 'New mission' }).click();
  const robots = page.locator('form.card .fields select').first();
  for (const text of await robots.locator('option').allInnerTexts()) expect(text.trim()).toMatch(/^rover-\d \(.+\)$/);
  await robots.selectOption('rover-2');
  for (const [label, value] of [
    ['Centre x, m', '8'],
    ['Centre y, m', '16'],
    ['Radius, m', '2'],
  ] as const) {
    await page.getByLabel(label).fill(value);
    await page.getByLabel(label).press('Tab');
  }
  await page.getByText('Options').click();
  await page.getByLabel('If the robot has other missions').selectOption('cancel them');
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.getByRole('button', { name: 'Send and cancel the others' }).click();
  await page.getByRole('button', { name: 'Cancel the others for good and send' }).click();
  await page.getByText('Sent to rover-2.').waitFor();
  await eventually('the other one is cancelled', async () => (await api<Mission>(`/v1/missions/${sent.id}`)).state === 'cancelled');
  await page.locator('.ended button', { hasText: 'rover-2' }).first().click();
  // Longer ones than those of an approach.
  await eventually('dashes', async () => (await dashOf('planned')) > 6);
  const { items } = await api<ApiPage<Mission>>('/v1/missions?site=yard&robot=rover-2&limit=1');
  if (items[0]) await api(`/v1/missions/${items[0].id}/cancel`, 'POST');
});
