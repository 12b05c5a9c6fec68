// The friction layer says by itself what it shows, what that means for a robot, and how it went over time.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import { colour } from '../src/map/cividis';
import { RANGES, shade } from '../src/map/friction';
import { demandOf, slipOf, stoppingM } from '../src/map/meaning';
import { moment, plain } from '../src/format';
import { texts } from '../src/texts';
import type { CellFriction, FusedFriction, Page as ApiPage, PointHistory, Robot, TerrainHistory } from './types';
import { api, browser, eventually, map, shot, windowOf } from './harness';

const { open } = browser();
const HOUR_MS = 3_600_000;

/** Measured cells of the map as it is now. */
async function measured(): Promise<CellFriction[]> {
  return eventually('measured cells', async () => {
    const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
    return items.length >= 5 && items;
  });
}

/** A place of the window over a measured cell with nothing else over it. */
async function overACell(page: Page): Promise<{ x: number; y: number; cell: CellFriction }> {
  const place = await windowOf(page);
  const box = await map(page);
  return eventually('a measured cell that can be pointed at', async () => {
    const robots = (await api<ApiPage<Robot>>('/v1/sites/yard/robots')).items.map((robot) => robot.live?.pose?.value);
    for (const cell of await measured()) {
      const at = { x_m: cell.cell.ix + 0.5, y_m: cell.cell.iy + 0.5 };
      const { x, y } = place(at.x_m, at.y_m);
      const isFree = robots.every((pose) => !pose || Math.hypot(pose.x_m - at.x_m, pose.y_m - at.y_m) > 1.5);
      const isInside = x < box.x + box.width - 280 && x > box.x + 60 && y > box.y + 60 && y < box.y + box.height - 60;
      if (isFree && isInside) return { x, y, cell };
    }
    return null;
  });
}

/** The share of a part of a canvas that has just this colour. */
function colouredShare(
  canvas: Element,
  { part, expected }: { part: { x: number; y: number; width: number; height: number }; expected: number[] },
): number {
  const context = (canvas as HTMLCanvasElement).getContext('2d');
  const { data } = context!.getImageData(part.x, part.y, part.width, part.height);
  let count = 0;
  for (let at = 0; at < data.length; at += 4) {
    if (expected.every((channel, index) => data[at + index] === channel)) count += 1;
  }
  return (4 * count) / data.length;
}

const place = (page: Page) => page.locator('[data-test="inspect"]');

test('friction is shown from the start, with a scale whose ends say what they mean', async () => {
  await measured();
  const page = await open();
  expect(await page.getByRole('combobox', { name: 'Friction' }).inputValue()).toBe('theta');
  const legend = page.locator('.layers figure');
  await legend.getByText(texts.map.ends.slippery, { exact: true }).waitFor();
  await legend.getByText(texts.map.ends.firm, { exact: true }).waitFor();
  await legend.getByText('How much the wheels slip when the robot turns or accelerates').waitFor();
  expect(await legend.getByText('θ = 1/K').isVisible()).toBe(false);
  // What θ means for the model of these robots, by its limits, and its formula are said to whoever asks.
  const robot = await api<Robot>('/v1/sites/yard/robots/rover-1');
  const demand = demandOf(robot.model);
  const row = legend.locator('tr', { has: page.getByRole('cell', { name: '0.2', exact: true }) });
  await legend.getByText('More', { exact: true }).click();
  const said = Number(/([\d.]+)$/.exec(await row.innerText())?.[1]);
  expect(Math.abs(said - (slipOf(0.2, demand) ?? NaN) * 100)).toBeLessThan(0.51);
  await legend.getByText(`turn of ${plain(demand.radius_m)} m radius`).waitFor();
  await legend.getByText('θ = 1/K is no friction coefficient').waitFor();
  await shot(page, 'friction-legend');
});

/** Puts another braking limit in the place of that of the robots. */
const braking = (acceleration_m_s2: number) => async (page: Page) => {
  // Robots come by the stream of events, whose messages are JSON.
  await page.addInitScript((limit) => {
    const parse = JSON.parse;
    JSON.parse = (text: string, ...more) => {
      const value = parse(text, ...more);
      if (value?.robot?.model) value.robot.model.limits.linear_acceleration_max_m_s2 = limit;
      return value;
    };
  }, acceleration_m_s2);
};

test('peak friction has a scale of its own, and what it means for a robot, once if it is always the same', async () => {
  await measured();
  const { model } = await api<Robot>('/v1/sites/yard/robots/rover-1');
  const [first = NaN] = RANGES.friction.ticks.filter((mu) => mu > 0);
  for (const limit_m_s2 of [0.5, 20]) {
    const page = await open({ prepare: braking(limit_m_s2) });
    const legend = page.locator('.layers figure');
    const background = () => legend.locator('.bar').evaluate((bar) => getComputedStyle(bar).backgroundImage);
    const ofSlip = await background();
    await page.getByRole('combobox', { name: 'Friction' }).selectOption('friction');
    await legend.getByText(texts.map.ends.littleShown, { exact: true }).waitFor();
    await legend.getByText('a low value is no warning').waitFor();
    expect(await background()).not.toBe(ofSlip);
    // Yellow is slippery ground, and is not on this scale.
    expect(await background()).not.toContain(`rgb(${RANGES.theta.scale(1).join(', ')})`);
    await legend.getByText('More', { exact: true }).click();
    await legend.getByText('It says nothing of θ.').waitFor();
    const demand = demandOf({ ...model, limits: { ...model.limits, linear_acceleration_max_m_s2: limit_m_s2 } });
    const stops_m = stoppingM(first, demand) ?? NaN;
    const constant = legend.locator('[data-test="constant"]');
    if (limit_m_s2 < first * 9.8) {
      // It brakes no harder than its model may, whatever the friction.
      const said = await constant.innerText();
      expect(Math.abs(Number(/stops within ([\d.]+) m/.exec(said)?.[1]) - stops_m)).toBeLessThan(0.0051);
      expect(await legend.locator('table').count()).toBe(0);
    } else {
      await legend.getByText('stops within this distance').waitFor();
      const row = legend.locator('tr', { has: page.getByRole('cell', { name: plain(first), exact: true }) });
      // Two decimals are shown, and a half may go either way.
      expect(Math.abs(Number(/([\d.]+)$/.exec(await row.innerText())?.[1]) - stops_m)).toBeLessThan(0.0051);
      expect(await constant.count()).toBe(0);
    }
    await shot(page, `friction-peak-${limit_m_s2 < 1 ? 'constant' : 'table'}`);
    await page.close();
  }
});

test('how unsure a value is shows in its hatching alone, and not in its colour', async () => {
  const theta = 0.5;
  /** Standard deviations over θ: not hatched, and ever denser. */
  const ratios = [0.02, 0.15, 0.3, 0.8];
  const shown: CellFriction[] = [];
  const page = await open({
    async prepare(page) {
      await page.route(/\/friction\/cells\?/, async (route) => {
        const response = await route.fetch();
        const answer = (await response.json()) as ApiPage<CellFriction>;
        const [sample] = await measured();
        if (!sample) throw new Error('nothing is measured');
        shown.length = 0;
        for (const [index, ratio] of ratios.entries()) {
          const friction = { ...sample.friction, theta, stiffness: 1 / theta, std_dev: ratio * theta };
          shown.push({ ...sample, size_m: 1, cell: { ix: 3 + 2 * index, iy: 19 }, friction });
        }
        await route.fulfill({ response, json: { ...answer, items: shown } });
      });
    },
  });
  await page.getByText('Layers', { exact: true }).click();
  for (const name of ['Trails', 'Terrains']) await page.getByRole('checkbox', { name }).uncheck();
  const place = await windowOf(page);
  const box = await map(page);
  await eventually('four cells', async () => shown.length === ratios.length);
  const expected = colour(shade(RANGES.theta, theta));
  const shares = await eventually('hatching', async () => {
    const all: number[] = [];
    for (const { cell } of shown) {
      const [from, to] = [place(cell.ix + 0.1, cell.iy + 0.9), place(cell.ix + 0.9, cell.iy + 0.1)];
      const part = { x: from.x - box.x, y: from.y - box.y, width: to.x - from.x, height: to.y - from.y };
      all.push(await page.getByRole('application', { name: /^Map/ }).evaluate(colouredShare, { part, expected }));
    }
    return (all[0] ?? 0) > 0.9 && all;
  });
  console.log(`share of a cell in its own colour, by hatching: ${shares.map((share) => share.toFixed(2)).join(', ')}`);
  // The same colour shows between the lines, of which there are more and more.
  for (const [index, share] of shares.slice(1).entries()) expect(share).toBeLessThan((shares[index] ?? 0) - 0.1);
  expect(shares.at(-2)).toBeGreaterThan(0.2);
  await shot(page, 'friction-unsure');
});

test('a click reads a place of the map in full, and Escape ends it', async () => {
  const page = await open();
  const { x, y, cell } = await overACell(page);
  await page.mouse.click(x, y);
  const card = place(page);
  await card.waitFor();
  const said = (name: string) => card.locator(`dt:has-text("${name}") + dd`).innerText();
  await eventually('what the API says', async () => {
    const { items } = await api<ApiPage<CellFriction>>('/v1/sites/yard/friction/cells?limit=1000');
    const here = items.filter((other) => other.cell.ix === cell.cell.ix && other.cell.iy === cell.cell.iy);
    const most = here.sort((a, b) => b.friction.segments - a.friction.segments)[0];
    const ends = (await said('95 % interval')).split(' – ').map(Number);
    const near = (text: number | undefined, value: number) => Math.abs((text ?? NaN) - value) <= 0.006 * value;
    return (
      most &&
      near(ends[0], most.friction.theta_low_95) &&
      near(ends[1], most.friction.theta_high_95) &&
      Number(await said('Robots')) === most.friction.robots &&
      Number(await said('Passes')) === most.friction.segments
    );
  });
  expect(await said('Newest measurement')).toMatch(/ago$/);
  expect(await said('Slip expected')).toMatch(/%$/);
  await shot(page, 'friction-place');
  await page.getByRole('application', { name: /^Map/ }).press('Escape');
  await card.waitFor({ state: 'detached' });
});

test('a tap reads a place on a phone', async () => {
  await measured();
  const page = await open({ size: { width: 390, height: 800 }, hasTouch: true });
  const box = await map(page);
  await page.touchscreen.tap(box.x + 20, box.y + box.height - 60);
  await place(page).getByRole('heading', { name: /^x .* m, y / }).waitFor();
  await shot(page, 'friction-phone');
});

test('keys read the middle of the map', async () => {
  await measured();
  const page = await open();
  const canvas = page.getByRole('application', { name: /^Map/ });
  await canvas.focus();
  await canvas.press('ArrowLeft');
  expect(await page.locator('output.cursor').innerText()).toMatch(/^x .* m, y .* m · ./);
  await canvas.press('Enter');
  await place(page).waitFor();
});

/** Puts θ that rises from hour to hour in place of what the server answers of the past. */
async function riseOverTime(page: Page): Promise<{ asked: string[] }> {
  const asked: string[] = [];
  const of = (at_ms: number, friction: FusedFriction | null, sample: FusedFriction): FusedFriction | null => {
    const hours = (Date.now() - at_ms) / HOUR_MS;
    if (hours > 12) return null;
    const theta = 0.4 - 0.02 * hours;
    return { ...(friction ?? sample), theta, theta_low_95: 0.8 * theta, theta_high_95: 1.25 * theta };
  };
  const cells = await measured();
  const sample = cells[0]?.friction;
  const configuration = cells[0]?.configuration;
  if (!sample || !configuration) throw new Error('nothing is measured');
  await page.route(/\/friction\/(terrains\/[^/]+|point)\/history\?/, async (route) => {
    asked.push(new URL(route.request().url()).searchParams.get('step_s') ?? '');
    const response = await route.fetch();
    const answer = (await response.json()) as TerrainHistory | PointHistory;
    for (const item of answer.items) {
      const friction = of(Date.parse(item.as_of), null, sample);
      item.models = [{ configuration, friction, model: 'rover', normalisation: null, prior: null }];
    }
    await route.fulfill({ response, json: answer });
  });
  return { asked };
}

test('the history of a cell and of a terrain is a curve with its interval', async () => {
  let asked: string[] = [];
  const page = await open({
    async prepare(page) {
      asked = (await riseOverTime(page)).asked;
    },
  });
  const { x, y } = await overACell(page);
  await page.mouse.click(x, y);
  await place(page).getByRole('button', { name: 'History' }).click();
  const said = place(page).getByText(/^θ 0\.1[678].* at first, 0\.[34]\d* at last\./);
  await said.waitFor();
  expect(asked).toEqual(['3600']);
  const line = place(page).locator('polyline');
  const points = ((await line.getAttribute('points')) ?? '').split(' ').map((point) => point.split(',').map(Number));
  expect(points).toHaveLength(12);
  // θ rises, so the line goes up, which is down in the picture's numbers.
  for (const [index, point] of points.slice(1).entries()) expect(point[1]).toBeLessThan(points[index]?.[1] ?? NaN);
  await shot(page, 'friction-history');
  await place(page).getByRole('combobox').selectOption('60 minutes');
  await eventually('a history of minutes', async () => asked.includes('60'));
  await eventually('a point a minute', async () => ((await line.getAttribute('points')) ?? '').split(' ').length >= 61);
  await page.getByRole('tab', { name: 'Terrains' }).click();
  asked.length = 0;
  const terrain = page.getByRole('listitem').filter({ hasText: 'Lawn' });
  await terrain.getByRole('button', { name: 'History' }).click();
  await terrain.locator('polyline').waitFor();
  expect(asked).toEqual(['3600']);
  await terrain.getByRole('combobox').selectOption('7 days');
  await terrain.getByText('at last').waitFor();
  await terrain.getByRole('combobox').selectOption('30 days');
  await eventually('a history of days', async () => asked.includes('86400'));
  await shot(page, 'friction-terrain-history');
});

test('the map is shown as of past hours, one after the other', async () => {
  await measured();
  const page = await open();
  const time = page.locator('[data-test="map-time"]');
  await time.getByText('now', { exact: true }).waitFor();
  const slider = time.getByRole('slider', { name: 'Time of the map' });
  const answer = page.waitForResponse((response) => response.url().includes('as_of='));
  await slider.focus();
  await slider.press('ArrowLeft');
  const answered = await answer;
  const stated = ((await answered.json()) as ApiPage<CellFriction> & { as_of: string }).as_of;
  expect(new URL(answered.url()).searchParams.get('as_of')).toMatch(/:00:00\.000Z$/);
  // The page says what the server has rounded to.
  await time.getByText(`as of ${moment(stated)}`).waitFor();
  // Nothing was measured before this hour, so the map is empty then.
  const { x, y } = await overACell(page);
  await eventually('an empty map', async () => {
    await page.mouse.move(x + 1, y);
    await page.mouse.move(x, y);
    return (await page.locator('[data-test="value"]').innerText()) === texts.map.noValue;
  });
  await page.getByText('Nothing had been measured here by then.').waitFor();
  await shot(page, 'friction-past');
  await page.getByRole('button', { name: 'Now' }).click();
  await time.getByText('now', { exact: true }).waitFor();
  await page.getByText('Nothing had been measured here by then.').waitFor({ state: 'hidden' });
  await eventually('the map of now', async () => {
    await page.mouse.move(x + 1, y);
    await page.mouse.move(x, y);
    return (await page.locator('[data-test="value"]').innerText()) !== texts.map.noValue;
  });
  await time.getByRole('combobox', { name: 'Span' }).selectOption('30 days');
  await time.getByText('now', { exact: true }).waitFor();
  const days: string[] = [];
  page.on('request', (request) => {
    const as_of = new URL(request.url()).searchParams.get('as_of');
    if (as_of) days.push(as_of);
  });
  await time.getByRole('button', { name: 'Play' }).click();
  await eventually('three days', async () => new Set(days).size >= 3);
  await time.getByRole('button', { name: 'Pause' }).click();
  expect([...days].sort()).toEqual(days);
  expect(days.every((day) => day.endsWith('T00:00:00.000Z'))).toBe(true);
  // Of the last hour each minute is known, and the server rounds nothing.
  await time.getByRole('combobox', { name: 'Span' }).selectOption('60 minutes');
  await time.getByText('now', { exact: true }).waitFor();
  const ofMinute = page.waitForResponse((response) => response.url().includes('as_of='));
  await slider.focus();
  await slider.press('ArrowLeft');
  const minute = await ofMinute;
  const asked = new URL(minute.url()).searchParams.get('as_of') ?? '';
  const { as_of } = (await minute.json()) as { as_of: string };
  expect(asked).toMatch(/:00\.000Z$/);
  expect(Date.parse(as_of)).toBe(Date.parse(asked));
});
