// Missions drawn with the mouse: dry run, sending, progress, history.
import { expect, test } from 'vitest';
import type { Mission, MissionDetail, Page as ApiPage, Terrain } from './types';
import { api, browser, eventually, metresAt, select, shot, windowOf } from './harness';

const { open } = browser();

/** The newest mission of a robot. */
async function newest(robot: string): Promise<Mission | null> {
  const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=1`);
  return items[0] ?? null;
}

async function cancelAll(robot: string): Promise<void> {
  const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=100`);
  for (const mission of items) {
    if (!mission.ended_at) await api(`/v1/missions/${mission.id}/cancel`, 'POST').catch(() => undefined);
  }
  await eventually('no open mission', async () => {
    const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=100`);
    return items.every((mission) => mission.ended_at);
  });
}

test('a circle is drawn with the mouse, tried, sent, driven, and shown with what was driven', async () => {
  await cancelAll('rover-1');
  const page = await open();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  const place = await windowOf(page);
  const from = place(8, 6);
  const to = place(9.2, 6);
  const center = await metresAt(page, from.x, from.y);
  await page.mouse.down();
  await page.mouse.move((from.x + to.x) / 2, to.y, { steps: 3 });
  await page.mouse.move(to.x, to.y, { steps: 3 });
  await page.mouse.up();
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.getByLabel('Speed, m/s').fill('0.8');
  await page.getByLabel('Turns').fill('0.5');
  await page.getByText('The dry run is under way').waitFor({ state: 'hidden' });
  await page.locator('[data-test="dry-run"]').waitFor();
  await shot(page, 'draw-circle');
  await page.getByRole('button', { name: 'Send', exact: true }).click();
  await page.getByText('Sent to rover-1.').waitFor();
  const sent = await newest('rover-1');
  if (!sent || !('circle' in sent.trajectory)) throw new Error('no circle was sent');
  const { circle } = sent.trajectory;
  expect(circle.center.x_m).toBeCloseTo(center.x_m, 1);
  expect(circle.center.y_m).toBeCloseTo(center.y_m, 1);
  expect(Math.abs(circle.radius_m - 1.2)).toBeLessThan(0.06);
  expect([circle.speed_m_s, circle.turns, circle.direction]).toEqual([0.8, 0.5, 'counter_clockwise']);
  const card = page.locator(`[data-mission="${sent.id}"]`);
  await card.locator('progress').waitFor();
  const driven = () => card.locator('progress').evaluate((bar: HTMLProgressElement) => bar.value);
  const first = await driven();
  await eventually('progress', async () => (await driven()) > first);
  const ended = await eventually('the end of the mission', async () => {
    const mission = await api<MissionDetail>(`/v1/missions/${sent.id}`);
    return mission.ended_at ? mission : null;
  });
  expect(ended.state).toBe('succeeded');
  await card.waitFor({ state: 'detached' });
  await page.locator('.ended button').first().click();
  await page.locator('[data-test="detail"]').getByText('Cross-track error, RMS').waitFor();
  const rms = (ended.quality?.cross_track_rms_m ?? NaN) * 1000;
  await page.locator('[data-test="detail"]').getByText(`${rms.toFixed(1)} mm`).first().waitFor();
  await shot(page, 'history');
});

test('waypoints are clicked, moved, deleted and taken back; paused, resumed, replaced and cancelled', async () => {
  await cancelAll('rover-3');
  const page = await open();
  await select(page, 'rover-3');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  const place = await windowOf(page);
  const points = [
    [18, 3],
    [22, 3],
    [25, 6],
    [22, 9],
  ] as const;
  for (const [x_m, y_m] of points) {
    const { x, y } = place(x_m, y_m);
    await page.mouse.click(x, y);
  }
  const inputs = page.getByLabel(/Point \d+, x in m/);
  expect(await inputs.count()).toBe(4);
  const third = place(25, 6);
  const moved = place(26, 6);
  await page.mouse.move(third.x, third.y);
  await page.mouse.down();
  await page.mouse.move(moved.x, moved.y, { steps: 4 });
  await page.mouse.up();
  expect(Math.abs(Number(await inputs.nth(2).inputValue()) - 26)).toBeLessThan(0.1);
  const last = place(22, 9);
  await page.mouse.click(last.x, last.y, { button: 'right' });
  expect(await inputs.count()).toBe(3);
  await page.getByRole('button', { name: 'Undo' }).click();
  expect(await inputs.count()).toBe(4);
  await page.getByLabel('Speed, m/s').fill('0.3');
  await page.locator('[data-test="dry-run"]').waitFor();
  await shot(page, 'draw-waypoints');
  await page.getByRole('button', { name: 'Send', exact: true }).click();
  const sent = await eventually('the mission at the server', async () => {
    const mission = await newest('rover-3');
    return mission && !mission.ended_at ? mission : null;
  });
  if (!('waypoints' in sent.trajectory)) throw new Error('no waypoints were sent');
  expect(sent.trajectory.waypoints.points.length).toBe(4);
  const card = page.locator(`[data-mission="${sent.id}"]`);
  await card.getByText('driving').waitFor();
  await card.getByRole('button', { name: 'Pause' }).click();
  await card.getByText('paused', { exact: true }).waitFor();
  await card.getByRole('button', { name: 'Resume' }).click();
  await card.getByText('driving').waitFor();
  await card.getByRole('button', { name: 'Replace' }).click();
  await page.getByLabel('Centre x, m').fill('21');
  await page.getByLabel('Centre y, m').fill('6');
  await page.getByLabel('Radius, m').fill('1.5');
  await page.getByLabel('Radius, m').press('Tab');
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.locator('form').getByRole('button', { name: 'Replace' }).click();
  await eventually('the replaced path', async () => {
    const mission = await api<MissionDetail>(`/v1/missions/${sent.id}`);
    return 'circle' in mission.trajectory && mission.revision > sent.revision;
  });
  await card.getByText('circle, radius 1.5 m').waitFor();
  await card.getByRole('button', { name: 'Cancel' }).click();
  await eventually('the cancelled mission', async () => {
    const mission = await api<MissionDetail>(`/v1/missions/${sent.id}`);
    return mission.state === 'cancelled';
  });
});

test('a path that cannot be driven is refused where it is drawn, and kept', async () => {
  const page = await open({ expected: /422/ });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('8');
  await page.getByLabel('Speed, m/s').fill('40');
  await page.getByLabel('Speed, m/s').press('Tab');
  const problem = page.locator('form .problem');
  await problem.waitFor();
  expect(await problem.innerText()).toMatch(/^[A-Z].*\.$/);
  expect(await page.getByRole('button', { name: 'Send', exact: true }).isEnabled()).toBe(false);
  expect(await page.getByLabel('Centre x, m').inputValue()).toBe('8');
  await shot(page, 'refused');
});

test('a terrain is drawn, classified, changed and deleted', async () => {
  const page = await open();
  await page.getByRole('tab', { name: 'Terrains' }).click();
  await page.getByRole('button', { name: 'New terrain' }).click();
  const id = `test-${Date.now()}`;
  await page.getByLabel('Identifier').fill(id);
  await page.getByLabel('Name').fill('Ice rink');
  await page.getByLabel('Ground').selectOption('ice');
  await page.getByLabel('Layer').fill('5');
  const place = await windowOf(page);
  for (const [x_m, y_m] of [
    [2, 2],
    [6, 2],
    [6, 5],
  ] as const) {
    const { x, y } = place(x_m, y_m);
    await page.mouse.click(x, y);
  }
  await page.getByRole('button', { name: 'Save' }).click();
  const card = page.getByRole('listitem').filter({ hasText: 'Ice rink' });
  await card.waitFor();
  await shot(page, 'terrains');
  const made = await api<Terrain>(`/v1/sites/yard/terrains/${id}`);
  expect([made.class, made.layer, made.polygon.length]).toEqual(['ice', 5, 3]);
  await card.getByRole('button', { name: 'Edit' }).click();
  await page.getByLabel('Ground').selectOption('snow');
  await page.getByRole('button', { name: 'Add point' }).click();
  await page.getByLabel('Point 4, x in m').fill('2');
  await page.getByLabel('Point 4, y in m').fill('5');
  await page.getByLabel('Point 4, y in m').press('Tab');
  await page.getByRole('button', { name: 'Save' }).click();
  const changed = await eventually('the changed terrain', async () => {
    const terrain = await api<Terrain>(`/v1/sites/yard/terrains/${id}`);
    return terrain.revision > made.revision && terrain;
  });
  expect([changed.class, changed.polygon.length]).toEqual(['snow', 4]);
  await card.getByText('snow').waitFor();
  await card.getByRole('button', { name: 'Delete' }).click();
  await card.getByRole('button', { name: 'Delete for good' }).click();
  await card.waitFor({ state: 'detached' });
});
