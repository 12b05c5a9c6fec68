// Alerts on the page: where each one leads, those of one kind or robot, and those of the past.
import { expect, test } from 'vitest';
import type { Alert, Mission, Page as ApiPage, Stop } from './types';
import { violations } from './checks';
import { api, browser, eventually, shot, windowOf } from './harness';

const { open } = browser();
const ROBOT = 'rover-2';
/** So near a place is shown at least, pixels per metre. */
const PLACE_PX_M = 35;
const alertsOf = async (query: string) => (await api<ApiPage<Alert>>(`/v1/alerts?site=yard&${query}`)).items;

test('an alert leads to its robot, its mission and its place, and is found again when it is over', async () => {
  const circle = { center: { x_m: 8, y_m: 16 }, radius_m: 2, speed_m_s: 0.4, turns: 20 };
  const order = { site: 'yard', robot: ROBOT, trajectory: { circle }, start_policy: 'replace' };
  const mission = await api<Mission>('/v1/missions', 'POST', order);
  await eventually('the mission is driven', async () => (await api<Mission>(`/v1/missions/${mission.id}`)).state === 'active');
  const stop = await api<Stop>(`/v1/sites/yard/robots/${ROBOT}/stop`, 'POST', {});
  const alert = await eventually('an alert', async () => (await alertsOf(`kind=stopped&robot=${ROBOT}&raised=true`))[0]);
  expect(alert.mission, 'it says which mission is stopped').toBe(mission.id);
  expect(alert.place, 'and where').toBeTruthy();

  const page = await open();
  const tab = page.getByRole('tab', { name: 'Alerts' });
  const selected = (name: string) => page.getByRole('tab', { name, selected: true }).waitFor();
  const card = page.locator(`[data-alert="${alert.id}"]`);
  await tab.click();
  await card.getByRole('button', { name: 'Show the place' }).click();
  const { x_m, y_m } = alert.place ?? { x_m: NaN, y_m: NaN };
  await eventually('the place near, and under no panel', async () => {
    const place = await windowOf(page);
    const [at, beside] = [place(x_m, y_m), place(x_m + 1, y_m)];
    const isSeen = await page.evaluate(({ x, y }) => document.elementFromPoint(x, y)?.localName === 'canvas', at);
    return isSeen && beside.x - at.x >= PLACE_PX_M;
  });
  expect(await violations(page), 'alerts').toEqual([]);
  await shot(page, 'alerts');
  await card.getByRole('button', { name: 'Open its mission' }).click();
  await selected('Missions');
  await page.locator('[data-test="detail"]').waitFor();
  await tab.click();
  await card.getByRole('button', { name: `Open ${ROBOT}` }).click();
  await selected('Robots');
  await page.getByRole('heading', { name: ROBOT }).waitFor();
  // The robot's own panel leads to the same mission and place.
  await page.getByRole('tabpanel').or(page.locator('.note, .problem')).getByRole('button', { name: 'Show the place' }).first().waitFor();

  // In German the alert is a German sentence, and the words of the server are marked as English.
  const german = await open({ locale: 'de-DE' });
  await german.getByRole('tab', { name: 'Meldungen' }).click();
  const same = german.locator(`[data-alert="${alert.id}"]`);
  await same.getByText(`Für ${ROBOT} gilt ein Stopp.`).waitFor();
  expect(await same.locator('[lang="en"]').innerText()).toBe(alert.text);
  expect(await violations(german), 'alerts in German').toEqual([]);
  await shot(german, 'alerts-de');
  await german.close();

  await tab.click();
  const kind = page.getByRole('combobox', { name: 'Kind' });
  const robot = page.getByRole('combobox', { name: 'Robot', exact: true });
  await robot.selectOption('rover-1');
  await card.waitFor({ state: 'detached' });
  await robot.selectOption(ROBOT);
  await kind.selectOption('stopped');
  await card.waitFor();
  await api(`/v1/sites/yard/robots/${ROBOT}/stop/clear`, 'POST', { stop: stop.id }).catch(() => undefined);
  await eventually('the end of the alert', async () => {
    await api(`/v1/sites/yard/robots/${ROBOT}/stop/clear`, 'POST', { stop: stop.id }).catch(() => undefined);
    return !(await alertsOf('raised=true')).some(({ id }) => id === alert.id);
  });
  await card.waitFor({ state: 'detached' });
  await page.getByRole('combobox', { name: 'Which alerts' }).selectOption('now and past');
  await card.waitFor();
  expect(await card.locator('time').count(), 'when it began and ended').toBe(2);
  expect(await violations(page), 'alerts of the past').toEqual([]);
  await shot(page, 'alerts-past');
  await robot.selectOption('rover-1');
  await card.waitFor({ state: 'detached' });
  await api(`/v1/missions/${mission.id}/cancel`, 'POST');
});
