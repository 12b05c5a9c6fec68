// What lies over what: robots beside the panels of the map, the map while something is drawn, and what fits into legends.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Page as ApiPage, Robot } from './types';
import { PALETTES } from '../src/map/palette';
import { RANGES } from '../src/map/friction';
import { violations } from './checks';
import { api, browser, eventually, map, select, shot, token } from './harness';

const { open } = browser();
const SIZES = {
  wide: { width: 1360, height: 850 },
  tablet: { width: 900, height: 1100 },
  phone: { width: 390, height: 800 },
  small: { width: 360, height: 640 },
} as const;

/** Where metres lie in the window, by the view that the address keeps. */
async function placeOf(page: Page): Promise<(at: { x_m: number; y_m: number }) => { x: number; y: number }> {
  const view = await eventually('the view in the address', async () =>
    /view=(-?[\d.]+),(-?[\d.]+),([\d.]+)/.exec(decodeURIComponent(page.url())),
  );
  const [x_m = NaN, y_m = NaN, scale = NaN] = view.slice(1).map(Number);
  const box = await map(page);
  return (at) => ({
    x: box.x + box.width / 2 + (at.x_m - x_m) * scale,
    y: box.y + box.height / 2 - (at.y_m - y_m) * scale,
  });
}

/** Robots of which the map shows nothing, or whose place is under something else. */
async function hidden(page: Page): Promise<string[]> {
  const place = await placeOf(page);
  const { items } = await api<ApiPage<Robot>>('/v1/sites/yard/robots');
  const found: string[] = [];
  for (const { id, live } of items) {
    if (!live?.pose) continue;
    const at = place(live.pose.value);
    const isCanvas = await page.evaluate(({ x, y }) => document.elementFromPoint(x, y)?.localName === 'canvas', at);
    if (!isCanvas) found.push(`${id} at ${Math.round(at.x)}, ${Math.round(at.y)}`);
  }
  return found;
}

for (const [name, size] of Object.entries(SIZES)) {
  test(`no robot lies under a panel of the map, at first, after Fit and after Show: ${name}`, async () => {
    const page = await open({ size, hasTouch: size.width < 760 });
    await page.getByRole('button', { name: 'Fit' }).waitFor();
    expect(await hidden(page)).toEqual([]);
    await shot(page, `layout-${name}`);
    for (let step = 0; step < 3; step += 1) await page.getByRole('button', { name: 'Zoom in' }).click();
    await page.getByRole('button', { name: 'Fit' }).click();
    await eventually('the robots in sight again', async () => (await hidden(page)).length === 0);
    // A terrain that is shown is not under the panel either.
    await page.getByRole('tab', { name: 'Terrains' }).click();
    const terrain = page.getByRole('listitem').filter({ hasText: 'Lawn' });
    await terrain.getByRole('button', { name: 'Show on map' }).click();
    await page.evaluate(() => scrollTo(0, 0));
    const { polygon } = (await api<ApiPage<{ name: string; polygon: { x_m: number; y_m: number }[] }>>('/v1/sites/yard/terrains')).items.find(
      (one) => one.name === 'Lawn',
    ) ?? { polygon: [] };
    expect(polygon.length).toBeGreaterThan(2);
    await eventually('the corners of the terrain in sight', async () => {
      const place = await placeOf(page);
      for (const corner of polygon) {
        const at = place(corner);
        if (!(await page.evaluate(({ x, y }) => document.elementFromPoint(x, y)?.localName === 'canvas', at))) return false;
      }
      return true;
    });
    await shot(page, `layout-${name}-terrain`);
  });
}

test('the place that is read and the panel beside it leave room for what is fitted', async () => {
  const page = await open();
  await page.getByRole('application', { name: /^Map/ }).press('Enter');
  await page.locator('[data-test="inspect"]').waitFor();
  await page.getByRole('button', { name: 'Fit' }).click();
  await eventually('all robots beside both', async () => (await hidden(page)).length === 0);
  await shot(page, 'layout-inspect');
});

test('on a phone the layers are a strip until somebody opens them', async () => {
  const page = await open({ size: SIZES.phone, hasTouch: true });
  const strip = page.locator('.layers summary.strip');
  await strip.getByText('Legend: Slip (θ)').waitFor();
  expect(await page.getByRole('combobox', { name: 'Friction' }).isVisible()).toBe(false);
  const box = await page.locator('.layers').boundingBox();
  expect(box?.height).toBeLessThan(40);
  await strip.click();
  await page.getByRole('combobox', { name: 'Friction' }).waitFor();
  expect(await violations(page)).toEqual([]);
  await shot(page, 'layers-phone-open');
  // What is drawn needs the map: it is a strip again.
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('combobox', { name: 'Friction' }).waitFor({ state: 'hidden' });
  await page.getByRole('button', { name: 'Discard' }).click();
  // Where there is room it has no strip.
  await page.setViewportSize(SIZES.wide);
  await page.getByRole('combobox', { name: 'Friction' }).waitFor();
  expect(await strip.isVisible()).toBe(false);
});

/** Labels of the scale that overlap each other or reach beyond the panel, and choices that a list cuts. */
const cutLabels = (page: Page) =>
  page.evaluate(() => {
    const found: string[] = [];
    const panel = document.querySelector('.layers');
    if (!panel) throw new Error('there are no layers');
    const box = panel.getBoundingClientRect();
    // With the room that its text keeps from its edge.
    const [left, right] = [box.left + 4, box.right - 4];
    for (const row of panel.querySelectorAll('.ticks, .ends, .unsure > .row')) {
      let last = left;
      for (const label of row.children) {
        const box = label.getBoundingClientRect();
        if (box.left < last || box.right > right) found.push(label.textContent ?? '');
        // A space parts them.
        last = box.right + 2;
      }
    }
    const brush = document.createElement('canvas').getContext('2d');
    if (!brush) throw new Error('there is no canvas');
    for (const list of panel.querySelectorAll('select')) {
      const style = getComputedStyle(list);
      brush.font = style.font;
      // The arrow of the list has some room of its own.
      const room = list.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight) - 18;
      for (const { text } of list.options) if (brush.measureText(text).width > room) found.push(text);
    }
    return found;
  });

for (const [name, size] of [
  ['wide', SIZES.wide],
  ['small', SIZES.small],
] as const) {
  for (const locale of ['en-US', 'de-DE']) {
    test(`no label of a scale or a list of the layers is cut: ${name}, ${locale}`, async () => {
      const page = await open({ size, locale, as: null });
      await page.locator('input[name="token"]').waitFor();
      await page.locator('input[name="token"]').fill(token());
      await page.locator('form button.main').click();
      await page.locator('.layers > details').evaluate((details: HTMLDetailsElement) => (details.open = true));
      const list = page.locator('.layers select').first();
      for (const quantity of [...Object.keys(RANGES), 'change']) {
        await list.selectOption(quantity);
        await page.locator('.layers figure .bar').waitFor();
        expect(await cutLabels(page), quantity).toEqual([]);
        await shot(page, `legend-${name}-${locale.slice(0, 2)}-${quantity}`);
      }
    });
  }
}

test('the layers show which line is a path and which the approach to it', async () => {
  const page = await open();
  await page.getByText('Layers', { exact: true }).click();
  const dashOf = (line: string) => page.locator(`.layers [data-line="${line}"] line`).getAttribute('stroke-dasharray');
  await page.getByText('path of a mission').waitFor();
  await page.getByText('approach to it').waitFor();
  expect(await dashOf('mission')).toBeNull();
  expect(await dashOf('approach')).toMatch(/^\d+ \d+$/);
  await shot(page, 'legend-lines');
});

test('the scale bar has a ground of its own over the layers', async () => {
  for (const theme of ['light', 'dark'] as const) {
    const page = await open({ theme });
    await page.locator('button[data-robot]').first().waitFor();
    const ground = PALETTES[theme].ground;
    const near = await page.getByRole('application', { name: /^Map/ }).evaluate((canvas, ground) => {
      const context = (canvas as HTMLCanvasElement).getContext('2d');
      const wanted = [1, 3, 5].map((at) => parseInt(ground.slice(at, at + 2), 16));
      const { height } = canvas as HTMLCanvasElement;
      // The corner below the bar: whatever is drawn there, it is nearly the ground.
      const { data } = context!.getImageData(16, height - 11, 20, 2);
      return [...data].every((value, index) => index % 4 === 3 || Math.abs(value - (wanted[index % 4] ?? 0)) < 30);
    }, ground);
    expect(near, theme).toBe(true);
    await shot(page, `scale-bar-${theme}`);
    await page.close();
  }
});

for (const name of ['phone', 'small'] as const) {
  const size = SIZES[name];
  test(`the map keeps 40 % of a phone while something is drawn, wherever the form is scrolled: ${name}`, async () => {
    const page = await open({ size, hasTouch: true });
    await select(page, 'rover-1');
    await page.getByRole('button', { name: 'New mission' }).click();
    await page.getByRole('radio', { name: 'Waypoints' }).check();
    for (let point = 0; point < 4; point += 1) await page.getByRole('button', { name: 'Add point' }).click();
    await page.getByText('Options').click();
    for (const share of [0, 0.5, 1]) {
      await page.evaluate((share) => scrollTo(0, share * document.documentElement.scrollHeight), share);
      const box = await map(page);
      const seen = Math.min(size.height, box.y + box.height) - Math.max(0, box.y);
      expect(seen, `scrolled by ${share}`).toBeGreaterThanOrEqual(0.4 * size.height);
      const middle = { x: box.x + box.width / 2, y: box.y + box.height / 2 };
      expect(await page.evaluate(({ x, y }) => document.elementFromPoint(x, y)?.localName, middle)).toBe('canvas');
      await shot(page, `draw-${name}-${share * 100}`);
    }
    // What has the focus is in sight between the map and the button that sends.
    await page.getByLabel('Priority').focus();
    const [field, foot, box] = [await page.getByLabel('Priority').boundingBox(), await page.locator('.foot').boundingBox(), await map(page)];
    expect(field?.y).toBeGreaterThanOrEqual(box.y + box.height);
    expect((field?.y ?? Infinity) + (field?.height ?? 0)).toBeLessThanOrEqual(foot?.y ?? 0);
    expect(await violations(page)).toEqual([]);
    // Drawing on it works where it is.
    const inputs = page.getByLabel(/^Point \d+, x/);
    await page.touchscreen.tap(box.x + box.width / 2, box.y + box.height - 70);
    expect(await inputs.count()).toBe(5);
    await page.getByRole('button', { name: 'Discard' }).click();
    // Afterwards the page scrolls as a whole.
    await page.evaluate(() => scrollTo(0, document.documentElement.scrollHeight));
    expect((await map(page)).y).toBeLessThan(0);
  });
}

test('on a phone the first steps and the note of what was discarded are a line each', async () => {
  const page = await open({ size: SIZES.small, hasTouch: true, kept: { 'tread-guide': 'open' } });
  const guide = page.locator('[data-test="guide"]');
  await guide.getByText(/^Step 2 of 3: /).waitFor();
  expect((await guide.boundingBox())?.height).toBeLessThan(48);
  await shot(page, 'guide-line');
  await guide.getByText(/^Step 2 of 3: /).click();
  await guide.getByRole('button', { name: 'Draw a mission' }).waitFor();
  expect(await violations(page)).toEqual([]);
  await guide.getByText(/^Step 2 of 3: /).click();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('8');
  await page.getByLabel('Centre x, m').press('Tab');
  await page.getByRole('button', { name: 'Discard' }).click();
  const note = page.getByRole('status').filter({ hasText: 'What you drew was discarded.' });
  await note.waitFor();
  expect((await note.boundingBox())?.height).toBeLessThan(48);
  expect(await violations(page)).toEqual([]);
  await shot(page, 'discarded-line');
  await note.getByRole('button', { name: 'Dismiss' }).click();
  await note.waitFor({ state: 'detached' });
  await guide.getByRole('button', { name: 'Close' }).click();
  await guide.waitFor({ state: 'detached' });
});
