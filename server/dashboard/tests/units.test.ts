// Feet and pounds: what is shown, what is typed, and what is sent.
import { expect, test } from 'vitest';
import type { Mission, MissionDetail, Page as ApiPage } from './types';
import { FOOT_M } from '../src/units';
import { violations } from './checks';
import { api, browser, eventually, map, select, shot } from './harness';

const { open } = browser();

async function newest(robot: string): Promise<Mission | null> {
  const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=1`);
  return items[0] ?? null;
}

test('units are those of the browser’s region, others if they are wanted, and stay', async () => {
  const page = await open({ kept: { 'tread-units': null } });
  await select(page, 'rover-1');
  const speed = page.locator('dt', { hasText: /^Speed$/ }).locator('+ dd').last();
  await speed.getByText('ft/s').waitFor();
  await page.getByRole('button', { name: 'Settings' }).click();
  await page.getByLabel('Units').selectOption('metric');
  await speed.getByText('m/s').waitFor();
  await page.reload();
  await speed.getByText('m/s').waitFor();
  const german = await open({ locale: 'de-DE', kept: { 'tread-units': null } });
  await german.locator('button[data-robot="rover-1"]').click();
  await german.locator('dt', { hasText: /^Geschwindigkeit$/ }).locator('+ dd').getByText(/\d,\d\d m\/s/).waitFor();
});

test('what is typed in feet is sent exactly, and comes back as it was typed', async () => {
  const page = await open({ kept: { 'tread-units': 'imperial' } });
  await select(page, 'rover-3');
  await page.getByRole('button', { name: 'New mission' }).click();
  const typed = { 'Centre x, ft': '70.3', 'Centre y, ft': '19.7', 'Radius, ft': '4.1', 'Speed, ft/s': '1.3' } as const;
  for (const [label, value] of Object.entries(typed)) {
    await page.getByLabel(label).fill(value);
    await page.getByLabel(label).press('Tab');
  }
  await page.locator('[data-test="dry-run"]').getByText(/\d\.\d ft,\s+approach\s+\d+\.\d ft/).waitFor();
  expect(await violations(page)).toEqual([]);
  await shot(page, 'imperial-draw');
  const shown = async () => {
    for (const [label, value] of Object.entries(typed)) expect(await page.getByLabel(label).inputValue(), label).toBe(value);
  };
  await shown();
  // The address keeps it as exactly.
  await eventually('the draft in the address', async () => page.url().includes('draft='));
  await page.reload();
  await page.getByLabel('Radius, ft').waitFor();
  await shown();
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.getByText('The dry run is under way').waitFor({ state: 'hidden' });
  await page.getByRole('button', { name: 'Send', exact: true }).click();
  await page.getByText('Sent to rover-3.').waitFor();
  const sent = await newest('rover-3');
  if (!sent || !('circle' in sent.trajectory)) throw new Error('no circle was sent');
  const { circle } = sent.trajectory;
  for (const [si, feet] of [
    [circle.center.x_m, 70.3],
    [circle.center.y_m, 19.7],
    [circle.radius_m, 4.1],
    [circle.speed_m_s, 1.3],
  ] as const) {
    expect(Math.abs((si ?? NaN) - feet * FOOT_M)).toBeLessThan(1e-9);
  }
  const card = page.locator(`[data-mission="${sent.id}"]`);
  await card.getByText('circle, radius 4.1 ft').waitFor();
  // The same once more, seen in metres meanwhile: nothing drifts.
  await card.getByRole('button', { name: 'Replace' }).click();
  await shown();
  const units = async (system: string) => {
    await page.getByRole('button', { name: 'Settings' }).click();
    await page.getByLabel('Units').selectOption(system);
    await page.keyboard.press('Escape');
  };
  await units('metric');
  expect(Number(await page.getByLabel('Radius, m').inputValue())).toBe(circle.radius_m);
  await units('imperial');
  await shown();
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.locator('form').getByRole('button', { name: 'Replace' }).click();
  const replaced = await eventually('the replaced path', async () => {
    const mission = await api<MissionDetail>(`/v1/missions/${sent.id}`);
    return mission.revision > sent.revision || mission.replacement ? mission : null;
  });
  // The pose from which it was planned is the robot's at that time, and the robot drives.
  const typedAgain = { circle: { ...circle, options: { ...circle.options, expected_start: expect.anything() } } };
  expect(replaced.trajectory).toEqual(typedAgain);
  await api(`/v1/missions/${sent.id}/cancel`, 'POST').catch(() => undefined);
});

test('map, legend, drive and planner speak of feet alone', async () => {
  const page = await open({ kept: { 'tread-units': 'imperial' } });
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('friction');
  await page.locator('.layers figure').getByText('More', { exact: true }).click();
  await page.getByText(/^From .* ft\/s .* ft\/s² at most\.$/).waitFor();
  const box = await map(page);
  await page.mouse.move(box.x + 200, box.y + 300);
  await page.locator('output.cursor').getByText(/^x -?[\d.]+ ft, y -?[\d.]+ ft/).waitFor();
  await shot(page, 'imperial-map');
  await select(page, 'rover-1');
  await page.locator('.uplot', { hasText: 'Cross-track error, in' }).waitFor();
  await page.locator('.uplot', { hasText: 'Speed, ft/s' }).waitFor();
  await page.getByRole('button', { name: 'Teleoperate' }).click();
  await page.getByText(/^Top speed: [\d.]+ ft\/s$/).waitFor();
  await shot(page, 'imperial-robot');
  await page.getByRole('button', { name: 'End teleoperation' }).click();
  const panel = await page.locator('#panel').innerText();
  expect(panel).not.toMatch(/\d (m|m\/s|kg|mm)\b/);
});
