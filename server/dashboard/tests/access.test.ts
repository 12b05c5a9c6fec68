// For everybody: axe-core on every part of the page, and a whole run by keys alone.
import type { Page } from 'playwright-core';
import { beforeAll, expect, test } from 'vitest';
import type { Mission, Page as ApiPage, Stop } from './types';
import { violations } from './checks';
import { agentOf, api, browser, eventually, line, select, shot, token } from './harness';

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

const SIZES = [
  ['wide', { width: 1360, height: 850 }],
  ['tablet', { width: 900, height: 1100 }],
  ['phone', { width: 390, height: 800 }],
] as const;

for (const theme of ['light', 'dark'] as const) {
  for (const [name, size] of SIZES) {
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
      // On a phone the layers are a strip again once something is drawn.
      const unfold = () => page.locator('.layers > details').evaluate((one: HTMLDetailsElement) => (one.open = true));
      await unfold();
      await page.getByRole('combobox', { name: 'Friction' }).selectOption('change');
      await page.getByLabel('Before').waitFor();
      expect(await violations(page), 'geofence and comparison').toEqual([]);
      await page.getByRole('button', { name: 'Discard' }).click();
      await unfold();
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
      await page.getByText('You control this robot.').waitFor();
      await page.getByRole('button', { name: 'Stop rover-3' }).click();
      const clear = page.getByRole('button', { name: 'Clear the stop of rover-3' });
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

/** What browsers say of a line that was cut, and of answers that tests let the server give. */
const EXPECTED = /ERR_|Failed to load|WebSocket|CSP: none|40[149]|412|422|503/;

for (const theme of ['light', 'dark'] as const) {
  for (const [name, size] of SIZES) {
    test(`nothing that goes wrong violates a rule of accessibility: ${theme}, ${name}`, async () => {
      const wire = await line();
      const page = await open({ theme, size, address: wire.address, expected: EXPECTED, kept: { 'tread-guide': 'open' } });
      await page.locator('[data-test="guide"]').waitFor();
      expect(await violations(page), 'first steps').toEqual([]);
      await page.locator('[data-test="guide"]').getByRole('button', { name: 'Close' }).click();

      // A draft that the server refuses, and one that sends others away.
      await select(page, 'rover-2');
      await page.getByRole('button', { name: 'Change tags' }).click();
      expect(await violations(page), 'tags').toEqual([]);
      await page.getByRole('button', { name: 'Cancel', exact: true }).click();
      await page.getByRole('button', { name: 'New mission' }).click();
      await page.getByLabel('Centre x, m').fill('8');
      await page.getByLabel('Centre y, m').fill('16');
      // Longer than any path may be.
      await page.getByLabel('Turns').fill('99999');
      await page.getByLabel('Turns').press('Tab');
      await page.locator('form .problem').first().waitFor();
      expect(await violations(page), 'a refused draft').toEqual([]);
      await shot(page, `refused-${theme}-${name}`);
      await page.getByRole('button', { name: 'Discard' }).click();
      expect(await violations(page), 'a discarded draft').toEqual([]);
      await page.getByRole('button', { name: 'Dismiss' }).click();

      // A geofence that somebody changed meanwhile.
      await page.getByRole('tab', { name: 'Terrains' }).click();
      await page.route('**/geofence', (route) =>
        route.request().method() === 'PUT'
          ? route.fulfill({ status: 412, contentType: 'application/problem+json', body: JSON.stringify({ type: '/problems/precondition-failed', title: 'It was changed', status: 412 }) })
          : route.fallback(),
      );
      await page.getByRole('button', { name: 'Area to stay out of' }).click();
      for (let corner = 0; corner < 3; corner += 1) await page.getByRole('button', { name: 'Add point' }).click();
      await page.getByRole('button', { name: 'Save' }).click();
      await page.getByText('Somebody changed the geofence meanwhile').waitFor();
      expect(await violations(page), 'a conflict of the geofence').toEqual([]);
      await page.getByRole('button', { name: 'Discard' }).click();

      // Webhooks, their form, and what asks once more.
      await page.getByRole('tab', { name: 'Alerts' }).click();
      await page.getByText('Webhooks', { exact: true }).click();
      await page.getByRole('button', { name: 'New webhook' }).click();
      await page.getByRole('checkbox', { name: 'all kinds' }).uncheck();
      expect(await violations(page), 'the form of a webhook').toEqual([]);

      // Stops of several robots of which one cannot answer.
      await page.getByRole('tab', { name: 'Robots' }).click();
      await page.getByRole('button', { name: 'All robots' }).click();
      await page.getByLabel('Select all 3').check();
      const bar = page.getByRole('region', { name: 'What to do with the selected robots' });
      await bar.getByRole('button', { name: 'Cancel missions' }).click();
      expect(await violations(page), 'what asks once more').toEqual([]);
      const agent = agentOf('rover-2');
      process.kill(agent, 'SIGSTOP');
      try {
        await bar.getByRole('button', { name: 'Stop', exact: true }).click();
        await page.getByText('rover-2 has NOT confirmed its stop').first().waitFor();
        await page.locator('[data-test="bulk"]').getByText(/NOT confirmed/).first().waitFor();
        expect(await violations(page), 'a stop that is not confirmed').toEqual([]);
        await shot(page, `unconfirmed-${theme}-${name}`);
      } finally {
        process.kill(agent, 'SIGCONT');
      }
      await bar.getByRole('button', { name: 'Clear stops' }).click();
      await bar.getByRole('button', { name: 'Clear the stops of 3 now' }).click();
      await page.locator('[data-test="bulk"]').getByText(/cleared|done|failed/).first().waitFor();
      expect(await violations(page), 'what became of each robot').toEqual([]);
      await eventually('no stop is in force', async () => {
        const { items } = await api<ApiPage<Stop>>('/v1/stops?site=yard&in_force=true');
        for (const { robot, id } of items) await api(`/v1/sites/yard/robots/${robot}/stop/clear`, 'POST', { stop: id }).catch(() => undefined);
        return items.length === 0;
      });

      // A server that is lost, and a stop that did not get there.
      wire.cut();
      await page.getByText(/^The server has not answered since/).waitFor();
      await page.keyboard.press('Alt+Shift+KeyX');
      await page.getByText(/the stop may not have arrived/).first().waitFor();
      expect(await violations(page), 'a lost server and a failed stop').toEqual([]);
      await shot(page, `lost-${theme}-${name}`);
      wire.end();
      await page.close();

      // Whoever may only look.
      const made = await api<{ secret: string }>('/v1/tokens', 'POST', { name: `viewer ${theme} ${name} ${Date.now()}`, role: 'viewer' });
      const viewer = await open({ theme, size, as: made.secret });
      for (const tab of ['Robots', 'Missions', 'Alerts', 'Terrains']) {
        await viewer.getByRole('tab', { name: tab }).click();
        expect(await violations(viewer), `${tab} of a viewer`).toEqual([]);
      }
      await viewer.close();
    }, 180_000);
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
  await tabTo(page, /^Clear the stop of rover-3/);
  await page.keyboard.press('Enter');
  await page.locator('[data-robot="rover-3"].held').waitFor({ state: 'detached' });
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});
