// Missions drawn with the mouse: dry run, sending, progress, history.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Geofence, Mission, MissionDetail, Page as ApiPage, PlannedPath, Terrain } from './types';
import { violations } from './checks';
import { api, browser, eventually, map, metresAt, select, shot, windowOf } from './harness';

const { open } = browser();

/** The newest mission of a robot. */
async function newest(robot: string): Promise<Mission | null> {
  const { items } = await api<ApiPage<Mission>>(`/v1/missions?site=yard&robot=${robot}&limit=1`);
  return items[0] ?? null;
}

/** Whether two sides of an outline cross or touch. */
function crosses(one: (readonly [number, number] | undefined)[], other: (readonly [number, number] | undefined)[]): boolean {
  const [[a, b] = [], [c, d] = []] = [one, other];
  if (!a || !b || !c || !d) return false;
  const turn = (p: readonly [number, number], q: readonly [number, number], r: readonly [number, number]) =>
    Math.sign((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]));
  return turn(a, b, c) * turn(a, b, d) <= 0 && turn(c, d, a) * turn(c, d, b) <= 0;
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
  await replayed(page, ended);
  await staysClosed(page);
});

/** Closes a mission while the server has not answered: the answer does not open it again. */
async function staysClosed(page: Page): Promise<void> {
  let release = () => {};
  const held = new Promise<void>((resolve) => (release = resolve));
  const address = /\/v1\/missions\/[0-9a-f-]{36}$/;
  await page.route(address, async (route) => {
    await held;
    await route.continue();
  });
  const asked = page.waitForRequest(address);
  await page.locator('.ended button').first().click();
  await asked;
  const detail = page.locator('[data-test="detail"]');
  await detail.getByRole('button', { name: 'Close' }).click();
  await detail.waitFor({ state: 'detached' });
  const planned = page.waitForResponse(/\/path$/);
  release();
  await planned;
  await page.waitForTimeout(300);
  expect(await detail.count()).toBe(0);
  await page.unroute(address);
}

/** Goes along the time line of an ended mission, by keys and by itself. */
async function replayed(page: Page, mission: MissionDetail): Promise<void> {
  const replay = page.locator('[data-test="replay"]');
  const said = async () => {
    const text = await replay.locator('output').innerText();
    const found = /^([\d.]+) \/ ([\d.]+) s · (\d+) mm off$/.exec(text);
    if (!found) throw new Error(`no moment in \`${text}\``);
    return { time_s: Number(found[1]), lasts_s: Number(found[2]), off_mm: Number(found[3]) };
  };
  const times = mission.driven?.times_s ?? [];
  expect(times.length).toBe(mission.driven?.points.length);
  const lasts_s = (times.at(-1) ?? 0) - (times[0] ?? 0);
  expect(Math.abs((await said()).lasts_s - lasts_s)).toBeLessThan(0.11);
  expect((await said()).time_s).toBe((await said()).lasts_s);
  const slider = page.getByLabel('Moment of the mission');
  await slider.focus();
  await slider.press('Home');
  expect((await said()).time_s).toBe(0);
  await slider.press('PageUp');
  expect((await said()).time_s).toBeGreaterThan(0);
  await slider.press('Home');
  await replay.getByRole('button', { name: 'Play' }).click();
  await eventually('the time line runs', async () => {
    const { time_s } = await said();
    return time_s > 1 && time_s < lasts_s;
  });
  await replay.getByRole('button', { name: 'Pause' }).click();
  const { off_mm } = await said();
  // The robot's own figure is measured against its reference, this one against the whole path.
  const worst_mm = (mission.quality?.cross_track_max_m ?? NaN) * 1000;
  expect(off_mm).toBeLessThanOrEqual(worst_mm + (mission.driven?.tolerance_m ?? 0) * 1000 + 5);
  await shot(page, 'replay');
}

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
  await page.getByText('The dry run is under way').waitFor({ state: 'hidden' });
  await shot(page, 'draw-waypoints');
  const planned = page.waitForResponse(/\/v1\/missions\/[^/]+\/path$/);
  await page.getByRole('button', { name: 'Send', exact: true }).click();
  const sent = await eventually('the mission at the server', async () => {
    const mission = await newest('rover-3');
    return mission && !mission.ended_at ? mission : null;
  });
  if (!('waypoints' in sent.trajectory)) throw new Error('no waypoints were sent');
  expect(sent.trajectory.waypoints.points.length).toBe(4);
  const path = (await (await planned).json()) as PlannedPath;
  expect(path.points.length).toBeGreaterThan(50);
  const card = page.locator(`[data-mission="${sent.id}"]`);
  await card.getByText('driving').waitFor();
  await card.getByRole('button', { name: 'Pause' }).click();
  await card.getByText('paused', { exact: true }).waitFor();
  await card.getByRole('button', { name: 'Resume' }).click();
  await card.getByText('driving').waitFor();
  await card.getByRole('button', { name: 'Replace' }).click();
  // It begins with what is driven, and with its speed.
  expect(await inputs.count()).toBe(4);
  expect(await page.getByLabel('Speed, m/s').inputValue()).toBe('0.3');
  await page.getByRole('radio', { name: 'Circle' }).check();
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
  await card.getByRole('button', { name: 'Cancel', exact: true }).click();
  // It asks once more.
  await card.getByRole('button', { name: 'Cancel it for good' }).click();
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

test('what is no number, and a path too tight, are said in a sentence each, and kept', async () => {
  const page = await open({ expected: /422/ });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  const problem = page.locator('form .problem');
  const type = async (label: string, value: string) => {
    await page.getByLabel(label).fill(value);
    await page.getByLabel(label).press('Tab');
  };
  await type('Centre x, m', '8');
  await type('Centre y, m', '6');
  await page.locator('[data-test="dry-run"]').waitFor();
  for (const [label, wrong, right, said] of [
    ['Radius, m', '-3', '2', 'The radius has to be a number of metres, at least 0.05.'],
    ['Speed, m/s', '', '0.5', 'The speed has to be a number of metres per second above 0.'],
    ['Speed, m/s', '40', '0.5', 'That is too fast: rover-1 drives at most 1 m/s.'],
    ['Turns', '0', '1', 'The turns have to be a number above 0.'],
    ['Centre x, m', '', '8', 'The centre needs two numbers, x and y.'],
  ] as const) {
    await type(label, wrong);
    await problem.getByText(said, { exact: true }).waitFor();
    expect(await page.getByLabel(label).inputValue()).toBe(wrong);
    expect(await page.getByRole('button', { name: 'Send', exact: true }).isEnabled()).toBe(false);
    await type(label, right);
    await page.locator('[data-test="dry-run"]').waitFor();
  }
  // This one only the server can tell.
  await type('Radius, m', '0.05');
  await problem.waitFor();
  expect(await problem.innerText()).toMatch(/^The path turns too sharply\.\s+robot `rover-1` cannot drive this: [^\d]+$/);
  expect(await page.getByLabel('Radius, m').inputValue()).toBe('0.05');
  // What was drawn of one kind is still there after a look at the other.
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  await page.getByRole('button', { name: 'Add point' }).click();
  await type('Point 1, y in m', '');
  await problem.getByText('Point 1 needs two numbers, x and y.').waitFor();
  await page.getByRole('radio', { name: 'Circle' }).check();
  expect(await page.getByLabel('Centre y, m').inputValue()).toBe('6');
});

test('a point at fault has the number of the table, is marked there, and can be shown on the map', async () => {
  const page = await open({ expected: /422/ });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  const points = [
    [4, 4],
    [8, 4],
    [8, 4],
  ] as const;
  for (const [index, [x_m, y_m]] of points.entries()) {
    await page.getByRole('button', { name: 'Add point' }).click();
    for (const [axis, value] of [['x', x_m], ['y', y_m]] as const) {
      await page.getByLabel(`Point ${index + 1}, ${axis} in m`).fill(String(value));
      await page.getByLabel(`Point ${index + 1}, ${axis} in m`).press('Tab');
    }
  }
  const problem = page.locator('form .problem');
  await problem.getByText('Point 3 is at the same place as the one before.', { exact: true }).waitFor();
  const field = page.getByLabel('Point 3, x in m');
  expect(await field.getAttribute('aria-invalid')).toBe('true');
  expect(await field.getAttribute('aria-describedby')).toBe(await problem.getAttribute('id'));
  expect(await page.locator('[aria-invalid="true"]').count()).toBe(2);
  expect(await page.getByText('Point 3 is at the same place').count()).toBe(1);
  expect(await violations(page)).toEqual([]);
  for (let step = 0; step < 2; step += 1) await page.getByRole('button', { name: 'Zoom out' }).click();
  await problem.getByRole('button', { name: 'Show on map' }).click();
  await shot(page, 'point-refused');
  await eventually('the point in sight', async () => {
    const [box, at] = [await map(page), (await windowOf(page))(8, 4)];
    return at.x > box.x + 40 && at.x < box.x + box.width - 280 && at.y > box.y + 40 && at.y < box.y + box.height - 40;
  });
  // What is no number is marked where it is missing alone.
  await field.fill('');
  await field.press('Tab');
  await problem.getByText('Point 3 needs two numbers, x and y.').waitFor();
  expect(await page.locator('[aria-invalid="true"]').count()).toBe(1);
  expect(await field.getAttribute('aria-invalid')).toBe('true');
  await field.fill('12');
  await field.press('Tab');
  await page.locator('[data-test="dry-run"]').waitFor();
  expect(await page.locator('[aria-invalid="true"]').count()).toBe(0);
});

test('time and length of the dry run are beside the button, and what slows it has the width of the card', async () => {
  for (const [name, size] of [['wide', { width: 1360, height: 850 }], ['phone', { width: 390, height: 800 }]] as const) {
    const page = await open({ size });
    await select(page, 'rover-1');
    await page.getByRole('button', { name: 'New mission' }).click();
    for (const [label, value] of [['Centre x, m', '8'], ['Centre y, m', '6'], ['Radius, m', '1.5'], ['Speed, m/s', '0.9']] as const) {
      await page.getByLabel(label).fill(value);
      await page.getByLabel(label).press('Tab');
    }
    const takes = page.locator('.foot [data-test="takes"]');
    await takes.getByText(/^Takes .* for \d+\.\d m\.$/).waitFor();
    const send = await page.getByRole('button', { name: 'Send', exact: true }).boundingBox();
    const said = await takes.boundingBox();
    expect(Math.abs((said?.y ?? 0) - (send?.y ?? 0))).toBeLessThan(80);
    const card = await page.locator('[data-test="dry-run"]').boundingBox();
    const slowed = await page.locator('[data-test="dry-run"] .whole').boundingBox();
    expect(slowed?.width).toBeGreaterThan(0.95 * (card?.width ?? Infinity));
    await page.locator('[data-test="dry-run"] .whole').scrollIntoViewIfNeeded();
    await shot(page, `dry-run-${name}`);
    await page.close();
  }
});

test('a path outside of where robots may be is refused in one sentence, and kept', async () => {
  const before = await api<Geofence>('/v1/sites/yard/geofence');
  const yard = [
    { x_m: -2, y_m: -2 },
    { x_m: 34, y_m: -2 },
    { x_m: 34, y_m: 26 },
    { x_m: -2, y_m: 26 },
  ];
  await api('/v1/sites/yard/geofence', 'PUT', { keep_in: [yard], keep_out: [] });
  try {
    const page = await open({ expected: /422/ });
    await select(page, 'rover-2');
    await page.getByRole('button', { name: 'New mission' }).click();
    await page.getByLabel('Centre x, m').fill('60');
    await page.getByLabel('Centre y, m').fill('6');
    await page.getByLabel('Centre y, m').press('Tab');
    const problem = page.locator('form .problem');
    await problem.waitFor();
    expect(await problem.innerText()).toMatch(/^The path leaves the geofence\.\s+[^.]*(\d\.\d+[^.]*)*$/);
    expect(await page.getByLabel('Centre x, m').inputValue()).toBe('60');
    expect(await page.getByRole('button', { name: 'Send', exact: true }).isEnabled()).toBe(false);
    await shot(page, 'outside');
  } finally {
    await api('/v1/sites/yard/geofence', 'PUT', { keep_in: before.keep_in, keep_out: before.keep_out });
  }
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

test('an area of the geofence is drawn, changed after a conflict, and deleted', async () => {
  const fence = () => api<Geofence>('/v1/sites/yard/geofence');
  const before = await fence();
  expect(before.keep_out).toEqual([]);
  // A refusal and a conflict are made on purpose.
  const page = await open({ expected: /412|422/ });
  await page.getByRole('tab', { name: 'Terrains' }).click();
  await page.getByRole('button', { name: 'Area to stay out of' }).click();
  const corners = [
    [-9, -9],
    [-5, -9],
    [-5, -5],
    [-9, -5],
  ] as const;
  /** First they cross. */
  const refused: [number, number][] = [[-9, -9], [-5, -9], [-9, -7], [-4, -8]];
  const set = async (label: string, value: number) => {
    await page.getByLabel(label).fill(String(value));
    await page.getByLabel(label).press('Tab');
  };
  for (const index of corners.keys()) {
    await page.getByRole('button', { name: 'Add point' }).click();
    const [x_m, y_m] = refused[index] ?? [];
    await set(`Point ${index + 1}, x in m`, x_m ?? NaN);
    await set(`Point ${index + 1}, y in m`, y_m ?? NaN);
  }
  await page.getByRole('button', { name: 'Save' }).click();
  // Said once, with the numbers of the table, and marked there; the server counts from 0.
  const problem = page.locator('form .problem');
  await problem.waitFor();
  const said = await problem.innerText();
  const [first = NaN, second = NaN] = /^The side from corner (\d) crosses or touches the side from corner (\d)\./.exec(said)?.slice(1).map(Number) ?? [];
  const sides = [first, second].map((number) => [number, (number % 4) + 1].map((corner) => refused[corner - 1]));
  expect(crosses(sides[0] ?? [], sides[1] ?? []), said).toBe(true);
  expect(await page.getByText('crosses or touches').count()).toBe(1);
  const marked = async () =>
    (await page.locator('.points [aria-invalid="true"]').evaluateAll((all) => all.map((one) => one.getAttribute('aria-label')))).map((label) =>
      Number(/^Point (\d)/.exec(label ?? '')?.[1]),
    );
  expect([...new Set(await marked())]).toEqual([first, second].sort());
  expect(await violations(page)).toEqual([]);
  await problem.getByRole('button', { name: 'Show on map' }).click();
  await eventually('the corners in sight', async () => {
    const place = await windowOf(page);
    const box = await map(page);
    return [first, second].every((number) => {
      const [x_m = NaN, y_m = NaN] = refused[number - 1] ?? [];
      const { x, y } = place(x_m, y_m);
      return x > box.x && x < box.x + box.width - 260 && y > box.y && y < box.y + box.height;
    });
  });
  await shot(page, 'fence-refused');
  // What is changed is no longer at fault.
  await set('Point 1, x in m', -8.5);
  expect(await marked()).toEqual([]);
  expect(await problem.count()).toBe(0);
  for (const [index, [x_m, y_m]] of corners.entries()) {
    await set(`Point ${index + 1}, x in m`, x_m);
    await set(`Point ${index + 1}, y in m`, y_m);
  }
  await page.getByRole('button', { name: 'Save' }).click();
  const areas = page.locator('[data-test="fence"]');
  await areas.getByText('Stay out, area 1').waitFor();
  await areas.getByText('16.0 m², 4 corners').waitFor();
  const made = await fence();
  expect(made.keep_out[0]?.[0]).toEqual({ x_m: -9, y_m: -9 });
  await areas.getByRole('button', { name: 'Edit' }).click();
  await set('Point 1, x in m', -10);
  // Somebody else is faster.
  await api('/v1/sites/yard/geofence', 'PUT', { keep_in: made.keep_in, keep_out: made.keep_out });
  await page.getByRole('button', { name: 'Save' }).click();
  await page.getByText('Somebody changed the geofence meanwhile').waitFor();
  await page.getByRole('button', { name: 'Save' }).click();
  const changed = await eventually('the changed geofence', async () => {
    const now = await fence();
    return now.revision > made.revision + 1 && now;
  });
  expect(changed.keep_out).toHaveLength(1);
  expect(changed.keep_out[0]?.[0]).toEqual({ x_m: -10, y_m: -9 });
  await areas.getByRole('button', { name: 'Show on map' }).click();
  await shot(page, 'fence');
  await areas.getByRole('button', { name: 'Delete' }).click();
  await areas.getByRole('button', { name: 'Delete for good' }).click();
  await areas.getByText('Stay out, area 1').waitFor({ state: 'detached' });
  expect((await fence()).keep_out).toEqual([]);
});
