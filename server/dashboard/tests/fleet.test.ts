// What whoever comes first sees: signing in, motion, the friction map, and a viewer's page.
import { expect, test } from 'vitest';
import type { CellDifference, CellFriction, CreatedToken, Mission, Page as ApiPage, Robot } from './types';
import { changeColour, shareOfChange } from '../src/map/compare';
import { minute, moment } from '../src/format';
import { texts } from '../src/texts';
import { api, browser, eventually, inked, map, select, server, shot, token, windowOf } from './harness';

const { open } = browser();
/** So many pixels of its ink are a curve, and no single point. */
const CURVE_PIXELS = 40;

test('a stranger sees the sign-in and nothing else', async () => {
  const page = await open({ as: null });
  await page.getByLabel('Token').waitFor();
  expect(await page.getByRole('button').allInnerTexts()).toEqual(['Sign in']);
  expect(await page.getByLabel('Token').evaluate((field) => field === document.activeElement)).toBe(true);
  await shot(page, 'sign-in');
});

test('a wrong token is refused in one sentence, and stays to be mended', async () => {
  const page = await open({ as: null, expected: /401/ });
  await page.getByLabel('Token').fill('tread_a_wrong');
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.getByRole('alert').waitFor();
  expect(await page.getByLabel('Token').inputValue()).toBe('tread_a_wrong');
});

test('robots are seen moving', async () => {
  const trajectory = { circle: { center: { x_m: 8, y_m: 6 }, radius_m: 2, speed_m_s: 0.6, turns: 5 } };
  const sent = await api<Mission>('/v1/missions', 'POST', {
    site: 'yard',
    robot: 'rover-1',
    trajectory,
    start_policy: 'replace',
  });
  const page = await open();
  await select(page, 'rover-1');
  const position = () => page.locator('dt:has-text("Position") + dd').innerText();
  const before = await position();
  const box = await map(page);
  const look = () => page.screenshot({ clip: { x: box.x, y: box.y, width: box.width, height: box.height - 60 } });
  const picture = await look();
  await eventually('another position', async () => (await position()) !== before);
  await eventually('another picture', async () => !(await look()).equals(picture));
  await shot(page, 'robot');
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});

test('the page is there again after a reload, without another sign-in', async () => {
  const page = await open();
  await page.reload();
  await page.locator('button[data-robot]').first().waitFor();
});

test('the friction layer says what the API says, at three places', async () => {
  const cells = await eventually('three measured cells', async () => {
    const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
    return items.length >= 3 && items;
  });
  const page = await open();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('theta');
  const place = await windowOf(page);
  const box = await map(page);
  let compared = 0;
  for (const { cell } of cells) {
    const { x, y } = place(cell.ix + 0.5, cell.iy + 0.5);
    // What lies under the box of layers cannot be pointed at.
    if (x > box.x + box.width - 260 || compared === 3) continue;
    await eventually('the value of the API', async () => {
      const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
      const here = items.filter((other) => other.cell.ix === cell.ix && other.cell.iy === cell.iy);
      const most = here.sort((a, b) => b.friction.segments - a.friction.segments)[0];
      await page.mouse.move(x + 1, y);
      await page.mouse.move(x, y);
      const said = await page.locator('[data-test="value"]').innerText();
      const found = /Slip \(θ\) ([\d.]+), 95 % ([\d.]+) to ([\d.]+) · (\d+) robots?, (\d+) passe?s? · [\d.]+ .*ago$/.exec(said);
      if (!most || !found) return false;
      const near = (text: string | undefined, value: number) => Math.abs(Number(text) - value) <= 0.006 * value;
      return (
        near(found[1], most.friction.theta) &&
        near(found[2], most.friction.theta_low_95) &&
        near(found[3], most.friction.theta_high_95) &&
        Number(found[4]) === most.friction.robots &&
        Number(found[5]) === most.friction.segments
      );
    });
    compared += 1;
  }
  expect(compared).toBe(3);
  await shot(page, 'friction');
});

test('from far the friction layer is read in larger squares, and whole', async () => {
  const fine = await eventually('measured cells', async () => {
    const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
    return items.length >= 3 && items;
  });
  const page = await open();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('visits');
  const side = (url: string) => Number(new URL(url).searchParams.get('resolution_m'));
  const coarse = page.waitForResponse((answer) => answer.url().includes('/friction/cells?') && side(answer.url()) >= 4);
  for (let step = 0; step < 14; step += 1) await page.getByRole('button', { name: 'Zoom out' }).click();
  const { items } = (await (await coarse).json()) as ApiPage<CellFriction>;
  expect(items[0]?.size_m).toBeGreaterThanOrEqual(4);
  // Each cell that somebody has measured lies in one of the squares that are read.
  const key = ({ cell, terrain }: CellFriction, factor: number) =>
    `${Math.floor(cell.ix * factor)} ${Math.floor(cell.iy * factor)} ${terrain?.id}`;
  const squares = new Set(items.map((square) => key(square, 1)));
  const lost = fine.filter((cell) => !squares.has(key(cell, cell.size_m / (items[0]?.size_m ?? 1))));
  expect(lost).toEqual([]);
  await shot(page, 'far');
});


test('two times of the friction map are compared', async () => {
  const from = new Date(Date.now() - 3_600_000).toISOString();
  const measured = await eventually('measured cells', async () => {
    const { items } = await api<ApiPage<CellDifference>>(`/v1/sites/yard/friction/difference?from=${from}&limit=1000`);
    return items.length >= 3 && items;
  });
  const page = await open();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('Change of slip');
  await page.getByLabel('Before').waitFor();
  await page.locator('.layers figure').getByText('white: within two standard deviations').waitFor();
  const place = await windowOf(page);
  const box = await map(page);
  const seen = measured.find(({ cell }) => place(cell.ix + 0.5, 0).x < box.x + box.width - 280);
  if (!seen) throw new Error('no cell can be pointed at');
  const { x, y } = place(seen.cell.ix + 0.5, seen.cell.iy + 0.5);
  await eventually('what the API says', async () => {
    await page.mouse.move(x + 1, y);
    await page.mouse.move(x, y);
    return (await page.locator('[data-test="value"]').innerText()) === 'measured for the first time';
  });
  await shot(page, 'compare');
  // Two times of one hour, and the page says which.
  const [before_ms, after_ms] = [2, 1].map((minutes) => (Math.floor(Date.now() / 60_000) - minutes) * 60_000) as [number, number];
  const enter = async (label: string, text: string) => {
    await page.getByLabel(label).fill(text);
    await page.getByLabel(label).press('Enter');
  };
  await enter('Before', minute(before_ms));
  await enter('After', minute(after_ms));
  const said = texts.map.compared(...([before_ms, after_ms].map((at) => moment(new Date(at).toISOString())) as [string, string]));
  await page.locator('[data-test="compared"]').getByText(said).waitFor();
  // Both times come back with the address.
  await eventually('the times in the address', async () => /from=.*Z&to=.*Z/.test(page.url()));
  await page.reload();
  await page.locator('[data-test="compared"]').getByText(said).waitFor();
  expect(await page.getByLabel('Before').inputValue()).toBe(minute(before_ms));
  expect(await page.getByLabel('After').inputValue()).toBe(minute(after_ms));
  // What is no time is said to be none.
  for (const wrong of ['', 'yesterday', '2026-02-31 12:00']) {
    await enter('Before', wrong);
    await page.getByText(/^Before: enter a time like \d{4}-\d\d-\d\d \d\d:\d\d\.$/).waitFor();
  }
  // Between two times of long ago nothing was measured.
  await enter('Before', '2020-01-01 00:00');
  await enter('After', '2020-02-01 00:00');
  await page.getByText('Nothing was measured between these times.').waitFor();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('Slip (θ)');
  await page.getByLabel('Before').waitFor({ state: 'detached' });
});

test('ground that has changed is red where θ rose, blue where it fell, and white within chance', async () => {
  const from = new Date(Date.now() - 3_600_000).toISOString();
  await eventually('measured cells', async () => {
    const { items } = await api<ApiPage<CellDifference>>(`/v1/sites/yard/friction/difference?from=${from}&limit=1000`);
    return items.length >= 3;
  });
  // What the server says of ground that was measured, as if it had been another before: the demo's
  // does not change. Every third cell has risen, fallen, or stayed.
  const before = [1 / 1.5, 2, 1] as const;
  const cells: CellDifference[] = [];
  const page = await open({
    async prepare(page) {
      await page.route(/\/friction\/difference\?/, async (route) => {
        const response = await route.fetch();
        const answer = (await response.json()) as ApiPage<CellDifference>;
        cells.length = 0;
        answer.items = answer.items.map((cell, index) => {
          const factor = before[index % 3] ?? 1;
          const was = cell.after ? { ...cell.after, theta: cell.after.theta * factor } : null;
          return { ...cell, before: was, z_score: factor === 1 ? 0.3 : factor < 1 ? 6 : -6 };
        });
        cells.push(...answer.items);
        await route.fulfill({ response, json: answer });
      });
    },
  });
  await page.getByText('Layers', { exact: true }).click();
  await page.getByRole('checkbox', { name: 'Trails' }).uncheck();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('Change of slip');
  await page.getByText('loading …').waitFor({ state: 'detached' });
  const place = await windowOf(page);
  const box = await map(page);
  const canvas = page.getByRole('application', { name: /^Map/ });
  const isSeen = ({ cell }: CellDifference) => place(cell.ix + 1, 0).x < box.x + box.width - 280;
  for (const [rest, said, colour] of [
    [0, '50.0 %, 6.0 standard deviations', changeColour(shareOfChange(1.5))],
    [1, '-50.0 %, -6.0 standard deviations', changeColour(-1)],
    [2, '0.0 %, 0.3 standard deviations', changeColour(0)],
  ] as const) {
    const shown = cells.find((cell, index) => index % 3 === rest && cell.after && isSeen(cell));
    if (!shown) throw new Error(`no cell of kind ${rest} can be pointed at`);
    const { x, y } = place(shown.cell.ix + 0.5, shown.cell.iy + 0.5);
    await eventually(`it says ${said}`, async () => {
      await page.mouse.move(x + 1, y);
      await page.mouse.move(x, y);
      return (await page.locator('[data-test="value"]').innerText()) === said;
    });
    expect(await inked(canvas, colour), said).toBeGreaterThan(CURVE_PIXELS);
  }
  await shot(page, 'changed');
});

test('the slip of the wheels is shown while they turn', async () => {
  const page = await open();
  await select(page, 'rover-2');
  const center = { x_m: 8, y_m: 14 };
  const sent = await api<Mission>('/v1/missions', 'POST', {
    site: 'yard',
    robot: 'rover-2',
    start_policy: 'replace',
    trajectory: { circle: { center, radius_m: 2, speed_m_s: 0.6, direction: 'clockwise', turns: 5 } },
  });
  const slip = page.locator('dt', { hasText: 'Wheel slip' }).locator('+ dd');
  await eventually('a slip within reason', async () => {
    const found = /^(-?[\d.]+), (-?[\d.]+) %$/.exec((await slip.innerText()).trim());
    const both = found && [Number(found[1]), Number(found[2])];
    return both && both.every((percent) => Math.abs(percent) < 60) && both.some((percent) => percent !== 0);
  });
  const curve = page.locator('.uplot', { has: page.locator('.u-title', { hasText: 'Wheel slip' }) });
  await eventually('a curve of the slip', async () => (await inked(curve.locator('canvas'), [11, 95, 165])) > CURVE_PIXELS);
  await curve.scrollIntoViewIfNeeded();
  await shot(page, 'slip');
  // Before it brakes: while wheels change their speed nobody knows their slip.
  await eventually('the API says a slip too', async () => {
    const robot = await api<Robot>('/v1/sites/yard/robots/rover-2');
    return robot.live?.friction?.value.slip;
  });
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});

test('a viewer sees Stop and nothing else that changes something', async () => {
  const made = await api<CreatedToken>('/v1/tokens', 'POST', { name: `viewer ${Date.now()}`, role: 'viewer' });
  const page = await open({ as: made.secret });
  const changes = /^(new|area|drive|pause|resume|cancel|replace|edit|delete|acknowledge|clear|save|send)/i;
  for (const tab of ['Robots', 'Missions', 'Alerts', 'Terrains']) {
    await page.getByRole('tab', { name: tab }).click();
    const names = await page.getByRole('button').allInnerTexts();
    expect(names.filter((name) => changes.test(name))).toEqual([]);
    expect(names).toContain('Stop all');
  }
  await select(page, 'rover-2');
  expect(await page.getByRole('button', { name: 'Stop rover-2' }).isEnabled()).toBe(true);
  const names = await page.getByRole('button').allInnerTexts();
  expect(names.filter((name) => changes.test(name))).toEqual([]);
  await shot(page, 'viewer');
});

test('whoever signs out is out, also for the server', async () => {
  const page = await open();
  await page.getByRole('button', { name: 'Sign out' }).click();
  await page.getByLabel('Token').waitFor();
  const cookies = await page.context().cookies(server());
  expect(cookies.filter((cookie) => cookie.name.includes('session'))).toEqual([]);
  expect(token()).toMatch(/^tread_/);
});
