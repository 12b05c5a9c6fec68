// What is wrong is seen first: stops that are not confirmed, robots in fault and out of contact, in fleets of any size.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Stop } from './types';
import { overflowing, violations } from './checks';
import { CROWD, crowd } from './crowd';
import { browser, eventually, inked, map, shot } from './harness';

const { open } = browser();

const SIZES = [
  ['wide', { width: 1360, height: 850 }],
  ['tablet', { width: 900, height: 1100 }],
  ['phone', { width: 390, height: 800 }],
] as const;
const ROBOTS = 500;
/** Names that were written on the map so long ago are still there, milliseconds: a busy machine writes few times a second. */
const WRITTEN_MS = 1_000;
/** So much of the height of the page the bar of stops may take, opened. */
const BAR_MAX = 0.6;

/** A stop of a robot that says nothing of it, since all robots of the crowd only say where they are. */
function stopOf(robot: string, index: number, confirmed: boolean): Stop {
  const at = '2026-01-31T14:05:09Z';
  const id = `0192f0c1-2b3c-7d4e-8f50-${String(index).padStart(12, '0')}`;
  const times = { requested_at: at, confirmed_at: confirmed ? at : null, standstill_at: confirmed ? at : null };
  return { id, site: 'yard', robot, by: 'demo', reason: 'test', unconfirmed: !confirmed, ...times } as Stop;
}

/** Puts stops in the place of those of the server: of the robots with these numbers. */
async function stopped(page: Page, confirmed: number[], unconfirmed: number[]): Promise<void> {
  const items = [
    ...confirmed.map((number) => stopOf(`crowd-${number}`, number, true)),
    ...unconfirmed.map((number) => stopOf(`crowd-${number}`, number, false)),
  ];
  await page.route(/\/v1\/stops\?/, (route) => route.fulfill({ json: { items, next_cursor: null } }));
}

const numbers = (from: number, count: number) => Array.from({ length: count }, (_, index) => from + index);
const rows = (page: Page) => page.locator('button[data-robot]');

/** Notes which names are written on the map, and when last. */
async function watchNames(page: Page): Promise<void> {
  await page.addInitScript(() => {
    const [names, pale] = [new Map<string, number>(), new Map<string, number>()];
    const { fillText } = CanvasRenderingContext2D.prototype;
    CanvasRenderingContext2D.prototype.fillText = function (...words) {
      if (this.textAlign === 'left') (this.globalAlpha < 1 ? pale : names).set(words[0], performance.now());
      fillText.apply(this, words);
    };
    Object.assign(globalThis, { names, pale });
  });
}

/** The names that are on the map now; something moves there, so that it is drawn all the time. */
const namesOn = (page: Page) => labelsOn(page, 'names');

/** The same of labels that are pale. */
const paleOn = (page: Page) => labelsOn(page, 'pale');

const labelsOn = (page: Page, which: 'names' | 'pale') =>
  page.evaluate(
    ([which, lasts]) => {
      const labels = (globalThis as unknown as Record<string, Map<string, number>>)[which] ?? new Map<string, number>();
      return [...labels].filter(([, at]) => performance.now() - at < lasts).map(([text]) => text);
    },
    [which, WRITTEN_MS] as const,
  );

/** Rows of the opened line of stops that are seen in part, after whatever scrolls has come to rest. */
const cutRows = (page: Page) =>
  page.locator('ul.listed').evaluate((list) => {
    const box = list.getBoundingClientRect();
    const rows = [...list.querySelectorAll('li')].map((row) => ({ row, ...row.getBoundingClientRect().toJSON() }));
    const isCut = ({ top, bottom }: { top: number; bottom: number }) =>
      (top < box.top - 1 && bottom > box.top + 1) || (top < box.bottom - 1 && bottom > box.bottom + 1);
    return rows.filter(isCut).map(({ row }) => row.textContent);
  });

for (const theme of ['light', 'dark'] as const) {
  for (const [name, size] of SIZES) {
    test(`many stops are a line for each state, whole rows when opened, and Stop stays in reach: ${theme}, ${name}`, async () => {
      const page = await open({
        theme,
        size,
        async prepare(page) {
          await crowd(page, ROBOTS);
          await stopped(page, numbers(1, 60), numbers(101, 12));
        },
      });
      const standing = page.getByRole('button', { name: '60 robots are stopped and stand still' });
      const unconfirmed = page.getByRole('button', { name: '12 robots have NOT confirmed their stop' });
      await standing.waitFor();
      await unconfirmed.waitFor();
      // What is red comes first.
      const states = page.locator('[data-state]');
      expect(await states.evaluateAll((all) => all.map((one) => one.getAttribute('data-state')))).toEqual(['unconfirmed', 'standstill']);
      expect(await violations(page), 'closed').toEqual([]);
      await shot(page, `stops-${theme}-${name}`);
      await standing.click();
      await page.getByRole('button', { name: 'Clear the stop of crowd-1', exact: true }).waitFor();
      expect(await violations(page), 'opened').toEqual([]);
      expect(await cutRows(page)).toEqual([]);
      const list = page.locator('ul.listed');
      await list.evaluate((element) => element.scrollBy(0, 50));
      await eventually('whole rows', async () => (await cutRows(page)).length === 0);
      await shot(page, `stops-open-${theme}-${name}`);
      const bar = await page.getByRole('region', { name: 'Stop' }).boundingBox();
      expect((bar?.height ?? Infinity) / size.height).toBeLessThan(BAR_MAX);
      for (const button of ['Stop all', 'Stop robot']) {
        const isReached = await page.getByRole('button', { name: button, exact: true }).evaluate((element) => {
          const { left, top, width, height } = element.getBoundingClientRect();
          return element.contains(document.elementFromPoint(left + width / 2, top + height / 2));
        });
        expect(isReached, button).toBe(true);
      }
      // Of two lines one is open, and it is closed again.
      await unconfirmed.click();
      await list.getByText('crowd-101').waitFor();
      expect(await list.count()).toBe(1);
      await unconfirmed.click();
      await list.waitFor({ state: 'detached' });
      expect(await overflowing(page)).toEqual([]);
    });
  }
}

test('three stops are three sentences, and the fourth makes lines of them', async () => {
  const page = await open({
    async prepare(page) {
      await crowd(page, 20, { fault: 0, lost: 0, stopped: 0, moving: 0 });
      await stopped(page, [1, 2], [3]);
    },
  });
  await page.getByText('crowd-1: stopped by demo. The robot stands still.', { exact: true }).waitFor();
  await page.getByText('crowd-3 has NOT confirmed its stop. The stop by demo is sent again until the robot confirms it.').waitFor();
  expect(await page.locator('[data-state]').count()).toBe(0);
  await page.unroute(/\/v1\/stops\?/);
  await stopped(page, [1, 2, 4], [3]);
  // It is read again while a stop is not confirmed.
  await page.getByRole('button', { name: '3 robots are stopped and stand still' }).waitFor();
  await page.getByText('crowd-3 has NOT confirmed its stop.').waitFor();
});

for (const [name, size, theme] of [
  ['wide', { width: 1360, height: 850 }, 'light'],
  ['phone', { width: 390, height: 800 }, 'dark'],
] as const) {
  test(`a robot whose stop is not confirmed comes first and says so in red, then those in fault: ${name}`, async () => {
    const page = await open({
      size,
      theme,
      async prepare(page) {
        await crowd(page, ROBOTS);
        await stopped(page, [], [321, 322]);
      },
    });
    const problem = rows(page).locator('.runs');
    await problem.first().waitFor();
    const texts = await rows(page).allInnerTexts();
    for (const [index, number] of [321, 322].entries()) {
      expect(texts[index]).toContain(`crowd-${number}`);
      expect(texts[index]).toContain('stop NOT confirmed');
    }
    expect(await problem.first().evaluate((element) => getComputedStyle(element).backgroundColor)).toBe('rgb(179, 18, 29)');
    for (const text of texts.slice(2, 2 + CROWD.fault)) {
      expect(text).toMatch(/⚠\s*fault/);
      expect(text).toContain('a motor is too hot');
    }
    // Those out of contact: since when, and where they were last.
    for (const text of texts.slice(2 + CROWD.fault, 2 + CROWD.fault + CROWD.lost)) {
      expect(text).toMatch(/offline since \d\d:\d\d/);
      expect(text).toMatch(/last at -?[\d.]+, -?[\d.]+ m/);
    }
    await page.locator('button[data-group="unconfirmed"]').getByText('stop not confirmed 2').waitFor();
    expect(await violations(page)).toEqual([]);
    expect(await overflowing(page)).toEqual([]);
    if (name === 'phone') await rows(page).first().scrollIntoViewIfNeeded();
    await shot(page, `trouble-${name}`);
    await page.locator('button[data-group="unconfirmed"]').click();
    await page.getByLabel('Select all 2').waitFor();
    await rows(page).first().click();
    await page.getByText('crowd-321 has NOT confirmed its stop. The stop by demo').last().waitFor();
  });
}

/** The canvas of the map. */
const canvas = (page: Page) => page.getByRole('application', { name: /^Map/ });

test('a robot in fault is red on the map, under a sign, and its label says so', async () => {
  const red = [0xb3, 0x12, 0x1d];
  const kinds = { fault: 0, lost: 0, stopped: 0, moving: 1 };
  const well = await open({ prepare: async (page) => (await watchNames(page), crowd(page, 3, kinds)) });
  await eventually('names', async () => (await namesOn(well)).length >= 3);
  expect(await inked(canvas(well), red)).toBe(0);
  await well.close();
  const page = await open({ prepare: async (page) => (await watchNames(page), crowd(page, 3, { ...kinds, fault: 1 })) });
  await eventually('a label with the fault', async () => (await namesOn(page)).some((name) => /^crowd-\d+ · fault$/.test(name)));
  // The robot itself, the triangle above it and the label.
  expect(await inked(canvas(page), red)).toBeGreaterThan(150);
  await shot(page, 'fault');
});

test('in a crowd the map names robots in trouble, selected and pointed at, the others are pale, and all have a label', async () => {
  const page = await open({ prepare: async (page) => (await watchNames(page), crowd(page, ROBOTS)) });
  await rows(page).first().waitFor();
  await page.mouse.move(5, 5);
  const inTrouble = CROWD.fault + CROWD.lost;
  // Labels change with the age that they state, and are shorter where there is less room: a robot is known by its number.
  const named = async () => new Set((await namesOn(page)).map((name) => `crowd-${/\d+/.exec(name)?.[0]}`));
  await eventually('robots in trouble and no others', async () => (await named()).size === inTrouble);
  // No label disappears: those of the others are short and pale.
  await eventually('all others have a pale label', async () => (await paleOn(page)).length >= ROBOTS - inTrouble);
  await shot(page, 'crowd-names');
  // The row that is pointed at in the list, and the one that is selected.
  const isNamed = async (id: string) => (await named()).has(id);
  await page.locator('button[data-group="idle"]').click();
  const id = (await rows(page).first().getAttribute('data-robot')) ?? '';
  await eventually('it is not named', async () => !(await isNamed(id)));
  await rows(page).first().hover();
  await eventually('the robot of the row is named', () => isNamed(id));
  await page.mouse.move(5, 5);
  await eventually('and no longer', async () => !(await isNamed(id)));
  await page.getByLabel(`Select ${id}`, { exact: true }).check();
  await page.mouse.move(5, 5);
  await eventually('a selected robot is named', () => isNamed(id));
  await page.getByRole('button', { name: 'Select none' }).click();
  await page.mouse.move(5, 5);
  // The one under the pointer: anywhere in the crowd some robot is near.
  await eventually('robots in trouble and no others again', async () => (await named()).size === inTrouble);
  const box = await map(page);
  await page.mouse.move(box.x + box.width * 0.4, box.y + box.height * 0.5);
  await eventually('the robot under the pointer is named', async () => (await named()).size === inTrouble + 1);
  await rows(page).first().click();
  await page.getByRole('button', { name: 'Show on map' }).click();
  await page.getByRole('button', { name: 'All robots' }).click();
  // From near there is room for all. What stands is not drawn again and again: each name since the last step counts.
  for (let step = 0; step < 4; step += 1) await page.getByRole('button', { name: 'Zoom in' }).click();
  await page.mouse.move(5, 5);
  await page.evaluate(() => (globalThis as unknown as { names: Map<string, number> }).names.clear());
  await page.getByRole('button', { name: 'Zoom in' }).click();
  await eventually('the robot in the middle and those around it are named', async () => {
    const near = await page.evaluate(() => [...(globalThis as unknown as { names: Map<string, number> }).names.keys()]);
    return near.length >= 4 && near.includes(id);
  });
  await shot(page, 'near-names');
});
