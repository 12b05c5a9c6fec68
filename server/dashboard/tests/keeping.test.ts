// What is shown, selected and drawn survives a reload; Escape ends it; Send is always in sight.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Mission, Page as ApiPage } from './types';
import { PATIENCE_MS, api, browser, eventually, map, metresAt, select, server, shot, windowOf } from './harness';

const { open } = browser();

const hash = (page: Page) => page.evaluate(() => decodeURIComponent(location.hash));
const says = (page: Page, part: string) =>
  eventually(`${part} in the address`, async () => (await hash(page)).includes(part));
const corner = async (page: Page) => {
  const box = await map(page);
  return metresAt(page, box.x + 30, box.y + 150);
};

async function reload(page: Page): Promise<void> {
  await page.reload();
  await page.getByRole('tablist').waitFor();
}

test('draft, view, selection and layer survive a reload, and go with the address', async () => {
  const page = await open();
  await page.getByRole('combobox', { name: 'Friction' }).selectOption('stiffness');
  await page.getByText('Layers', { exact: true }).click();
  await page.getByRole('checkbox', { name: 'Trails' }).uncheck();
  await page.getByLabel('Select rover-1', { exact: true }).check();
  await page.getByLabel('Select rover-3', { exact: true }).check();
  await page.getByRole('region', { name: 'What to do' }).getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  const place = await windowOf(page);
  for (const [x_m, y_m] of [
    [4, 4],
    [8, 6],
    [12, 5],
  ] as const) {
    const { x, y } = place(x_m, y_m);
    await page.mouse.click(x, y);
  }
  await page.getByLabel('Speed, m/s').fill('0.45');
  await page.getByText('Options').click();
  await page.getByLabel('Priority').fill('7');
  await page.getByLabel('Point 2, x in m').fill('');
  await page.getByLabel('Point 2, x in m').press('Tab');
  for (let step = 0; step < 2; step += 1) await page.getByRole('button', { name: 'Zoom in' }).click();
  await page.getByRole('application', { name: /^Map/ }).focus();
  await page.keyboard.press('ArrowLeft');
  const before = await corner(page);
  await says(page, '"priority":"7"');
  await says(page, 'layer=stiffness');
  await says(page, 'selected=rover-1,rover-3');
  await says(page, 'hidden=trails');
  await shot(page, 'before-reload');
  await reload(page);
  const same = async (page: Page) => {
    await page.getByRole('heading', { name: 'To 2 robots' }).waitFor();
    expect(await page.getByLabel(/^Point \d, x/).count()).toBe(3);
    // What was typed and is no number is still missing, and said so.
    expect(await page.getByLabel('Point 2, x in m').inputValue()).toBe('');
    expect(await page.getByLabel('Speed, m/s').inputValue()).toBe('0.45');
    await page.getByText('Options').click();
    expect(await page.getByLabel('Priority').inputValue()).toBe('7');
    expect(await page.getByRole('combobox', { name: 'Friction' }).inputValue()).toBe('stiffness');
    await page.getByText(/^2 selected$/).waitFor();
    await eventually('the same view', async () => {
      const now = await corner(page);
      return Math.abs(now.x_m - before.x_m) < 0.03 && Math.abs(now.y_m - before.y_m) < 0.03;
    });
  };
  await same(page);
  await shot(page, 'after-reload');
  // Somebody else opens the same address.
  const address = page.url();
  const other = await open({ address });
  await same(other);
});

test('what was selected just before a reload is selected after it', async () => {
  const page = await open();
  for (const robot of ['rover-2', 'rover-1', 'rover-3']) {
    await select(page, robot);
    await page.getByRole('heading', { name: robot }).waitFor();
    await says(page, `robot=${robot}`);
    await page.getByRole('button', { name: 'All robots' }).click();
    await says(page, 'site=yard');
    await eventually('no robot in the address', async () => !(await hash(page)).includes('robot='));
    // At once, before the address says so.
    const isBack = page.waitForEvent('domcontentloaded');
    await page.evaluate((robot) => {
      document.querySelector<HTMLElement>(`button[data-robot="${robot}"]`)?.click();
      location.reload();
    }, robot);
    await isBack;
    await page.getByRole('heading', { name: robot }).waitFor();
  }
});

test('what is selected while a slow server answers a reload is selected after it', async () => {
  const page = await open();
  await page.getByRole('tab', { name: 'Robots' }).click();
  await says(page, 'site=yard');
  let answer: () => void = () => undefined;
  const isAnswered = new Promise<void>((resolve) => (answer = resolve));
  await page.route(`${server()}/`, async (route) => {
    await isAnswered;
    await route.continue();
  });
  const isBack = page.waitForEvent('domcontentloaded');
  // In the page itself, since Playwright does nothing more in it before the reload is over.
  await page.evaluate(async (patienceMs) => {
    location.reload();
    document.querySelector<HTMLElement>('button[data-robot="rover-3"]')?.click();
    const end = performance.now() + patienceMs;
    while (!location.hash.includes('robot=rover-3')) {
      if (performance.now() > end) throw new Error(`no robot in ${location.hash}`);
      await new Promise(requestAnimationFrame);
    }
  }, PATIENCE_MS);
  answer();
  await isBack;
  await page.getByRole('heading', { name: 'rover-3' }).waitFor();
});

test('a robot that is open, a tab, and what a mission is replaced by survive a reload', async () => {
  const trajectory = { circle: { center: { x_m: 8, y_m: 6 }, radius_m: 2, speed_m_s: 0.3, turns: 20 } };
  const body = { site: 'yard', robot: 'rover-1', trajectory, start_policy: 'replace' };
  const sent = await api<Mission>('/v1/missions', 'POST', body);
  const page = await open();
  await select(page, 'rover-2');
  await says(page, 'robot=rover-2');
  await reload(page);
  await page.getByRole('heading', { name: 'rover-2' }).waitFor();
  await page.getByRole('tab', { name: 'Missions' }).click();
  const card = page.locator(`[data-mission="${sent.id}"]`);
  await card.getByText('driving').waitFor();
  await card.getByRole('button', { name: 'Replace' }).click();
  await page.getByLabel('Radius, m').fill('1.75');
  await page.getByLabel('Radius, m').press('Tab');
  await says(page, '"radius_m":"1.75"');
  await reload(page);
  await page.getByRole('heading', { name: 'Replace what rover-1 drives' }).waitFor();
  expect(await page.getByLabel('Radius, m').inputValue()).toBe('1.75');
  expect(await page.getByRole('tab', { name: 'Missions' }).getAttribute('aria-selected')).toBe('true');
  await page.locator('[data-test="dry-run"]').waitFor();
  await page.getByRole('button', { name: 'Discard' }).click();
  await eventually('no draft in the address', async () => !(await hash(page)).includes('draft'));
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});

test('a draft that is too long for an address survives a reload too', async () => {
  const page = await open();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByRole('radio', { name: 'Waypoints' }).check();
  const points = Array.from({ length: 900 }, (_, index) => `${index / 100},${index % 7}`).join(';');
  const draft = { what: 'mission', kind: 'waypoints', points, robot: 'rover-1', speed_m_s: '0.5', turns: '1', priority: '0' };
  // As if somebody had drawn for an hour.
  await page.evaluate((text) => (location.hash = `#site=yard&robot=rover-1&draft=${encodeURIComponent(text)}`), JSON.stringify(draft));
  await page.getByRole('button', { name: 'Discard' }).click();
  const isShort = async () => (await page.evaluate(() => location.hash.length)) < 6_000;
  // The same address once more would be no change.
  await eventually('an address without the draft', isShort);
  await page.evaluate((text) => (location.hash = `#site=yard&robot=rover-1&draft=${encodeURIComponent(text)}`), JSON.stringify(draft));
  await page.getByLabel('Point 100, x in m').waitFor();
  await eventually('a short address', isShort);
  await reload(page);
  await page.getByLabel('Point 100, x in m').waitFor();
});

test('Escape ends what is drawn, then what is open, then what is selected, and a draft can be brought back', async () => {
  const page = await open();
  await page.getByLabel('Select rover-1', { exact: true }).check();
  await page.getByLabel('Select rover-2', { exact: true }).check();
  await select(page, 'rover-3');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('7');
  await page.getByLabel('Centre x, m').press('Tab');
  await page.keyboard.press('Escape');
  await page.getByLabel('Centre x, m').waitFor({ state: 'detached' });
  await page.getByRole('button', { name: 'Bring it back' }).click();
  expect(await page.getByLabel('Centre x, m').inputValue()).toBe('7');
  await page.keyboard.press('Escape');
  await page.getByRole('heading', { name: 'rover-3' }).waitFor();
  await page.keyboard.press('Escape');
  await page.getByText(/^2 selected$/).waitFor();
  await page.getByLabel('Search by name').fill('rover-2');
  await page.keyboard.press('Escape');
  expect(await page.getByLabel('Search by name').inputValue()).toBe('');
  await page.getByText(/^2 selected$/).waitFor();
  await page.keyboard.press('Escape');
  await page.getByText(/^2 selected$/).waitFor({ state: 'detached' });
  const { items } = await api<ApiPage<Mission>>('/v1/missions?site=yard&robot=rover-3&limit=1');
  await page.getByRole('tab', { name: 'Missions' }).click();
  await page.locator('.ended button').first().click();
  await page.locator('[data-test="detail"]').waitFor();
  await page.keyboard.press('Escape');
  await page.locator('[data-test="detail"]').waitFor({ state: 'detached' });
  expect(items.length).toBeLessThanOrEqual(1);
});

for (const [name, size, hasTouch] of [
  ['wide', { width: 1360, height: 850 }, false],
  ['small', { width: 1024, height: 600 }, false],
  ['tablet', { width: 820, height: 1180 }, true],
  ['phone', { width: 390, height: 800 }, true],
  ['phone-across', { width: 800, height: 360 }, true],
  ['phone-narrow', { width: 320, height: 568 }, true],
] as const) {
  test(`Send and Stop all are in sight wherever somebody scrolls: ${name}`, async () => {
    const page = await open({ size, hasTouch });
    await select(page, 'rover-2');
    await page.getByRole('button', { name: 'New mission' }).click();
    await page.getByRole('radio', { name: 'Waypoints' }).check();
    for (let point = 0; point < 12; point += 1) await page.getByRole('button', { name: 'Add point' }).click();
    await page.getByText('Options').click();
    /** Whether a press in its middle is a press on it. */
    const isHit = (label: string) =>
      page.getByRole('button', { name: label, exact: true }).evaluate((button) => {
        const { left, top, width, height } = button.getBoundingClientRect();
        const at = document.elementFromPoint(left + width / 2, top + height / 2);
        const isIn = left >= 0 && top >= 0 && left + width <= innerWidth && top + height <= innerHeight;
        return isIn && at !== null && button.contains(at);
      });
    for (const share of [0, 0.5, 1]) {
      await page.evaluate((share) => {
        const panel = document.querySelector('#panel');
        for (const one of [panel, document.scrollingElement]) one?.scrollTo(0, share * one.scrollHeight);
      }, share);
      for (const label of ['Send', 'Discard', 'Stop all']) expect(await isHit(label), `${label} at ${share}`).toBe(true);
    }
    await shot(page, `send-${name}`);
    // What it covers can be scrolled into sight.
    const last = page.locator('#panel').locator('button, figure, p').last();
    await last.scrollIntoViewIfNeeded();
    await page.getByLabel('If the robot loses the server').scrollIntoViewIfNeeded();
    await page.getByLabel('If the robot loses the server').selectOption('stop after 5 s');
  });
}
