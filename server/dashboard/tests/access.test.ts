// For everybody: axe-core on every part of the page, and a whole run by keys alone.
import type { Page } from 'playwright-core';
import { beforeAll, expect, test } from 'vitest';
import type { Mission, Page as ApiPage } from './types';
import { violations } from './checks';
import { api, browser, eventually, select, shot, token } from './harness';

const { open } = browser();
/** How long a short mission may take, milliseconds. */
const MISSION_MS = 55_000;

// A mission that has succeeded is looked at, whichever tests ran before.
beforeAll(async () => {
  const succeeded = async () =>
    (await api<ApiPage<Mission>>('/v1/missions?site=yard&state=succeeded&limit=1')).items.length > 0;
  if (await succeeded()) return;
  const circle = { center: { x_m: 8, y_m: 16 }, radius_m: 2, speed_m_s: 0.6, turns: 0.1 };
  const order = { site: 'yard', robot: 'rover-2', trajectory: { circle }, start_policy: 'replace' };
  await api<Mission>('/v1/missions', 'POST', order);
  await eventually('a mission that has succeeded', succeeded, MISSION_MS);
});

for (const theme of ['light', 'dark'] as const) {
  for (const [name, size] of [
    ['wide', { width: 1360, height: 850 }],
    ['tablet', { width: 900, height: 1100 }],
    ['phone', { width: 390, height: 800 }],
  ] as const) {
    test(`no part of the page violates a rule of accessibility: ${theme}, ${name}`, async () => {
      const stranger = await open({ as: null, theme, size, expected: /401/ });
      await stranger.getByLabel('Token').waitFor();
      expect(await violations(stranger)).toEqual([]);
      await stranger.getByLabel('Token').fill('tread_wrong');
      await stranger.getByRole('button', { name: 'Sign in' }).click();
      await stranger.getByText('The server does not know this token').waitFor();
      expect(await violations(stranger), 'refused').toEqual([]);
      await stranger.close();
      const page = await open({ theme, size });
      expect(await violations(page)).toEqual([]);
      await page.locator('.layers details').evaluateAll((all) => {
        for (const details of all) if (details instanceof HTMLDetailsElement) details.open = true;
      });
      await page.getByRole('combobox', { name: 'Friction' }).selectOption('theta');
      await page.locator('.layers figure').waitFor();
      // A time that is past, and back to the present.
      const time = page.getByRole('slider', { name: 'Time of the map' });
      await time.press('ArrowLeft');
      await page.locator('[data-test="map-time"]').getByText(/^as of/).waitFor();
      expect(await violations(page), 'the past').toEqual([]);
      await time.press('ArrowRight');
      await page.getByRole('button', { name: 'Settings' }).click();
      expect(await violations(page), 'settings').toEqual([]);
      await page.keyboard.press('Escape');
      // The place in the middle of the map, with its history.
      await page.getByRole('application', { name: /^Map/ }).press('Enter');
      const place = page.locator('[data-test="inspect"]');
      await place.getByRole('button', { name: 'History' }).click();
      await place.locator('[data-test="history"]').waitFor();
      expect(await violations(page), 'place').toEqual([]);
      await place.getByRole('button', { name: 'Close' }).click();
      for (const tab of ['Missions', 'Alerts', 'Terrains']) {
        await page.getByRole('tab', { name: tab }).click();
        expect(await violations(page), tab).toEqual([]);
      }
      await page.getByRole('button', { name: 'Area to stay in' }).click();
      await page.getByRole('button', { name: 'Add point' }).click();
      await page.getByRole('combobox', { name: 'Friction' }).selectOption('change');
      await page.getByLabel('Before').waitFor();
      expect(await violations(page), 'geofence and comparison').toEqual([]);
      await page.getByRole('button', { name: 'Discard' }).click();
      await page.getByRole('combobox', { name: 'Friction' }).selectOption('theta');
      const past = page.locator('.ended button', { hasText: 'succeeded' }).first();
      await page.getByRole('tab', { name: 'Missions' }).click();
      await past.click();
      await page.locator('[data-test="replay"]').waitFor();
      expect(await violations(page), 'replay').toEqual([]);
      await select(page, 'rover-3');
      expect(await violations(page), 'robot').toEqual([]);
      await page.getByRole('button', { name: 'New mission' }).click();
      await page.getByRole('radio', { name: 'Waypoints' }).check();
      await page.getByRole('button', { name: 'Add point' }).click();
      await page.getByText('Options').click();
      expect(await violations(page), 'drawing').toEqual([]);
      await page.getByRole('button', { name: 'Discard' }).click();
      await page.getByRole('button', { name: 'Teleoperate' }).click();
      await page.getByText('You have the lease.').waitFor();
      await page.getByRole('button', { name: 'Stop rover-3' }).click();
      const clear = page.getByRole('button', { name: 'Clear rover-3' });
      await clear.waitFor();
      expect(await violations(page), 'driving, stopped').toEqual([]);
      await shot(page, `${theme}-${name}`);
      await page.getByRole('tab', { name: 'Alerts' }).click();
      await page.locator('[data-alert]').first().waitFor();
      expect(await violations(page), 'alerts').toEqual([]);
      await page.getByRole('combobox', { name: 'Which alerts' }).selectOption('now and past');
      await page.locator('[data-alert]').first().waitFor();
      expect(await violations(page), 'alerts of the past').toEqual([]);
      await eventually('the clear', async () => {
        if (await clear.isVisible()) await clear.click({ timeout: 2_000 });
        return !(await clear.isVisible());
      });
      // With the page goes its lease.
      await page.close();
    });
  }
}

/** Moves on by Tab until something of that name has the focus. */
async function tabTo(page: Page, name: RegExp): Promise<void> {
  const seen: string[] = [];
  for (let step = 0; step < 80; step += 1) {
    const now = await page.evaluate(() => {
      const at = document.activeElement;
      if (!(at instanceof HTMLElement)) return '';
      const label = at instanceof HTMLInputElement || at instanceof HTMLSelectElement ? at.labels?.[0]?.innerText : '';
      return at.getAttribute('aria-label') ?? (label || at.innerText);
    });
    if (name.test(now)) return;
    seen.push(now.split('\n')[0] ?? '');
    await page.keyboard.press('Tab');
  }
  throw new Error(`Tab never comes to ${name}: ${seen.join(' | ')}`);
}

test('a whole run by keys alone: sign in, select, draw, send, stop, clear', async () => {
  const page = await open({ as: null });
  await page.getByLabel('Token').waitFor();
  await tabTo(page, /^Token/);
  await page.keyboard.type(token());
  await page.keyboard.press('Enter');
  await page.locator('button[data-robot]').first().waitFor();
  await tabTo(page, /^Keys/);
  await page.keyboard.press('Enter');
  await page.getByText('stop all robots').waitFor();
  await page.keyboard.press('Enter');
  await page.getByText('stop all robots').waitFor({ state: 'hidden' });
  await tabTo(page, /^rover-\d/);
  // The rows are one stop of Tab; arrows go on from there.
  await page.keyboard.press('End');
  while (!(await page.locator('button[data-robot="rover-3"]').evaluate((row) => row === document.activeElement))) {
    await page.keyboard.press('ArrowUp');
  }
  await page.keyboard.press('Enter');
  await tabTo(page, /^New mission/);
  await page.keyboard.press('Enter');
  await page.getByRole('radio', { name: 'Circle' }).waitFor();
  // Back to the map, whose middle becomes the circle's.
  await tabTo(page, /^Map/);
  await page.keyboard.press('f');
  await page.keyboard.press('ArrowLeft');
  await page.keyboard.press('Enter');
  await tabTo(page, /^Radius/);
  await page.keyboard.press('ControlOrMeta+a');
  await page.keyboard.type('1.2');
  await page.keyboard.press('Tab');
  await page.locator('[data-test="dry-run"]').waitFor();
  await tabTo(page, /^Send/);
  await page.keyboard.press('Enter');
  await page.getByText('Sent to rover-3.').waitFor();
  const { items } = await api<ApiPage<Mission>>('/v1/missions?site=yard&robot=rover-3&limit=1');
  const sent = items[0];
  if (!sent || !('circle' in sent.trajectory)) throw new Error('no circle was sent');
  expect(sent.trajectory.circle.radius_m).toBe(1.2);
  await page.keyboard.press('Alt+KeyX');
  await page.locator('[data-robot="rover-3"].held').waitFor();
  await eventually('rover-3 stands', async () => {
    const robot = await api<{ live: { twist: { value: { linear_m_s: number } } } }>('/v1/sites/yard/robots/rover-3');
    return Math.abs(robot.live.twist.value.linear_m_s) < 0.02;
  });
  await tabTo(page, /^Clear rover-3/);
  await page.keyboard.press('Enter');
  await page.locator('[data-robot="rover-3"].held').waitFor({ state: 'detached' });
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});
