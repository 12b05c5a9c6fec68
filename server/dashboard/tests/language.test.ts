// The page in each of its languages: what chooses it, that nothing of another one is left, and that it fits.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { Geofence, Page as ApiPage, Robot, Site, Terrain } from './types';
import { DICTIONARIES, type Texts } from '../src/texts';
import { LANGUAGES, type Language } from '../src/locale';
import { overflowing, violations } from './checks';
import { api, browser, eventually, select, shot } from './harness';

const { open } = browser();
const LOCALES: Record<Language, string> = { en: 'en-US', de: 'de-DE' };
/** How long a tour of all screens may take on a busy machine, milliseconds. */
const TOUR_MAX_MS = 300_000;
/** A word of at least so many letters tells its language. */
const LETTERS_MIN = 4;

const langOf = (page: Page) => page.evaluate(() => document.documentElement.lang);

/** Every word of a dictionary, as far as its functions tell by numbers and names. */
function wordsOf(dictionary: unknown): Set<string> {
  const found = new Set<string>();
  const look = (value: unknown): void => {
    if (typeof value === 'string') for (const word of words(value)) found.add(word);
    else if (typeof value === 'function') {
      for (const sample of [[1, 1, 1, 1], [3, 3, 3, 3]]) {
        try {
          look((value as (...of: unknown[]) => unknown)(...sample));
        } catch {
          // It takes more than that.
        }
      }
    } else if (typeof value === 'object' && value !== null) for (const part of Object.values(value)) look(part);
  };
  look(dictionary);
  return found;
}

function words(text: string): string[] {
  return (text.toLowerCase().match(/\p{L}+/gu) ?? []).filter((word) => word.length >= LETTERS_MIN);
}

/** Names that the server gives, in whatever language they are. */
async function given(): Promise<Set<string>> {
  const lists = await Promise.all([
    api<ApiPage<Site>>('/v1/sites'),
    api<ApiPage<Robot>>('/v1/sites/yard/robots'),
    api<ApiPage<Terrain>>('/v1/sites/yard/terrains'),
  ]);
  const [sites, robots, terrains] = lists.map(({ items }) => items) as [Site[], Robot[], Terrain[]];
  const names = [...sites.map(({ name }) => name), ...terrains.map(({ name }) => name)];
  for (const { name, model } of robots) names.push(name, model.name, model.tyres);
  return new Set(words(names.join(' ')));
}

/** All that people see and hear of the page, but what is marked as being in another language. */
function shownOn(page: Page): Promise<string> {
  return page.evaluate(() => {
    const found: string[] = [document.title];
    const look = (node: Node): void => {
      if (node instanceof Text) found.push(node.data);
      if (!(node instanceof Element)) return;
      const isOther = node !== document.documentElement && node.hasAttribute('lang');
      if (isOther || node instanceof HTMLScriptElement || node instanceof HTMLStyleElement || node.localName === 'noscript') return;
      for (const name of ['aria-label', 'title', 'placeholder', 'alt', 'aria-valuetext']) {
        // The only title in English: the name of a time zone.
        if (!(name === 'title' && node.localName === 'time')) found.push(node.getAttribute(name) ?? '');
      }
      for (const child of node.childNodes) look(child);
    };
    look(document.documentElement);
    return found.join(' \n');
  });
}

/** Goes through the page and looks at each of its screens. */
async function tour(page: Page, texts: Texts, look: (screen: string) => Promise<void>): Promise<void> {
  const button = (name: string) => page.getByRole('button', { name, exact: true });
  await look('robots');
  await page.getByRole('checkbox', { name: texts.robots.mark('rover-2') }).check();
  await page.getByRole('checkbox', { name: texts.robots.mark('rover-3') }).check();
  await look('selected');
  await button(texts.robots.unmark).click();
  // On a phone the layers are a strip.
  await page.locator('.layers > details').evaluate((one) => ((one as HTMLDetailsElement).open = true));
  for (const quantity of ['stiffness', 'friction', 'age', 'visits', 'change', 'theta']) {
    await page.getByRole('combobox', { name: texts.map.friction, exact: true }).selectOption(quantity);
    await page.locator('.layers figure').waitFor();
    await page.locator('.layers details').evaluateAll((all) => all.forEach((one) => ((one as HTMLDetailsElement).open = true)));
    await look(`map ${quantity}`);
  }
  await page.getByRole('application').press('Enter');
  const place = page.locator('[data-test="inspect"]');
  await place.getByRole('button', { name: texts.map.history }).click();
  await place.locator('[data-test="history"] select').waitFor();
  await look('place');
  await place.getByRole('button', { name: texts.map.close }).click();
  if (await page.locator('.keys').isVisible()) await page.locator('.keys summary').click();
  await look('keys');
  if (await page.locator('.keys').isVisible()) await page.locator('.keys summary').click();
  await button(texts.settings.title).click();
  await look('settings');
  await page.keyboard.press('Escape');
  await page.getByRole('tab', { name: texts.tabs.missions }).click();
  await page.locator('.ended button', { hasText: texts.missions.state.succeeded }).first().click();
  await page.locator('[data-test="replay"]').waitFor();
  await look('mission');
  await page.locator('[data-test="detail"]').getByRole('button', { name: texts.missions.close }).click();
  await button(texts.missions.create).click();
  await look('circle');
  await page.getByRole('radio', { name: texts.draw.waypoints }).check();
  for (let point = 0; point < 3; point += 1) await button(texts.draw.add).click();
  await page.getByText(texts.draw.options).click();
  await page.locator('[data-test="dry-run"]').waitFor();
  await look('waypoints');
  await button(texts.draw.cancel).click();
  await page.getByRole('tab', { name: texts.tabs.alerts }).click();
  await page.getByText(texts.webhooks.title).click();
  await look('alerts');
  await page.getByRole('tab', { name: texts.tabs.terrains }).click();
  await button(texts.map.history).first().click();
  await page.locator('#panel [data-test="history"] select').waitFor();
  await look('terrains');
  await button(texts.terrains.create).click();
  await button(texts.draw.add).click();
  await look('terrain');
  await button(texts.draw.cancel).click();
  await page.getByRole('tab', { name: texts.tabs.robots }).click();
  await page.locator('button[data-robot="rover-3"]').click();
  await page.locator('.uplot').first().waitFor();
  await look('robot');
  await button(texts.drive.begin).click();
  await page.getByText(texts.drive.have).waitFor();
  await look('driving');
  await button(texts.stop.one('rover-3')).click();
  const clear = button(texts.stop.clear('rover-3'));
  await clear.waitFor();
  await look('stopped');
  await eventually('the clear', async () => {
    if (await clear.isVisible()) await clear.click({ timeout: 2_000 });
    return !(await clear.isVisible());
  });
}

const english = wordsOf(DICTIONARIES.en);
const german = wordsOf(DICTIONARIES.de);

for (const language of LANGUAGES) {
  for (const [name, size, theme] of [
    ['wide', { width: 1360, height: 850 }, 'light'],
    ['phone', { width: 390, height: 800 }, 'dark'],
  ] as const) {
    test(`every screen is whole in its language, accessible, and fits: ${language}, ${name}`, async () => {
      const texts = DICTIONARIES[language];
      const [mine, others] = language === 'de' ? [german, english] : [english, german];
      const names = await given();
      const foreign = [...others].filter((word) => !mine.has(word) && !names.has(word));
      expect(foreign.length).toBeGreaterThan(300);
      const look = async (page: Page, screen: string) => {
        const seen = new Set(words(await shownOn(page)));
        expect(foreign.filter((word) => seen.has(word)), `${screen}: words of another language`).toEqual([]);
        expect(await violations(page), screen).toEqual([]);
        if (await page.locator('#panel').isVisible()) expect(await overflowing(page), screen).toEqual([]);
        await shot(page, `${language}-${name}-${screen.replaceAll(' ', '-')}`);
      };
      const stranger = await open({ size, theme, locale: LOCALES[language], as: null });
      await stranger.locator('input[name="token"]').waitFor();
      await look(stranger, 'sign-in');
      await stranger.close();
      const page = await open({ size, theme, locale: LOCALES[language], kept: { 'tread-guide': 'open' } });
      await tour(page, texts, (screen) => look(page, screen));
    }, TOUR_MAX_MS);
  }
}

test('the language is the browser’s, another one if that is wanted, and stays', async () => {
  const page = await open({ locale: 'de-AT', as: null });
  await page.getByRole('button', { name: 'Anmelden' }).waitFor();
  expect(await langOf(page)).toBe('de');
  await page.getByLabel('Sprache').selectOption('en');
  await page.getByRole('button', { name: 'Sign in' }).waitFor();
  expect(await langOf(page)).toBe('en');
  await page.reload();
  await page.getByRole('button', { name: 'Sign in' }).waitFor();
  const other = await open({ locale: 'fr-FR', as: null });
  await other.getByRole('button', { name: 'Sign in' }).waitFor();
});

test('another language changes everything at once, also what was drawn, and loses none of it', async () => {
  const page = await open();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('8');
  await page.getByLabel('Centre x, m').press('Tab');
  await page.getByLabel('Speed, m/s').fill('40');
  await page.getByText('That is too fast').first().waitFor();
  await page.getByRole('button', { name: 'Settings' }).click();
  await page.getByLabel('Language').selectOption('de');
  await page.getByText('Das ist zu schnell').first().waitFor();
  expect(await page.getByLabel('Mittelpunkt x, m').inputValue()).toBe('8');
  await page.keyboard.press('Escape');
  await page.locator('#settings').waitFor({ state: 'detached' });
  // Escape closed the settings alone, and the focus is where they were opened.
  expect(await page.evaluate(() => document.activeElement?.getAttribute('aria-label'))).toBe('Einstellungen');
  await page.getByRole('radio', { name: 'Kreis' }).waitFor();
  await page.locator('.uplot', { hasText: 'Querabweichung, mm' }).waitFor();
  expect(await page.locator('output.cursor').count()).toBe(1);
});

test('German numbers have a comma, and times keep their one format', async () => {
  const page = await open({ locale: 'de-DE' });
  await page.getByRole('tab', { name: 'Missionen' }).click();
  // One that was driven: others have no tracking error.
  await page.locator('.ended button', { hasText: 'erledigt' }).first().click();
  const detail = page.locator('[data-test="detail"]');
  await detail.getByText(/^\d+,\d mm$/).first().waitFor();
  for (const time of await page.locator('time').all()) {
    expect(await time.innerText()).toMatch(/^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d$/);
  }
});

test('a refusal of the server has a German title', async () => {
  const before = await api<Geofence>('/v1/sites/yard/geofence');
  const yard = [-2, 34].flatMap((x_m) => [-2, 26].map((y_m) => ({ x_m, y_m: x_m < 0 ? y_m : 24 - y_m })));
  await api('/v1/sites/yard/geofence', 'PUT', { keep_in: [yard], keep_out: [] });
  try {
    const page = await open({ locale: 'de-DE', expected: /422/ });
    await page.locator('button[data-robot="rover-2"]').click();
    await page.getByRole('button', { name: 'Neue Mission' }).click();
    await page.getByLabel('Mittelpunkt x, m').fill('60');
    await page.getByLabel('Mittelpunkt x, m').press('Tab');
    const problem = page.locator('form .problem');
    await problem.waitFor();
    expect(await problem.innerText()).toMatch(/^Die Bahn verlässt den Geofence\./);
    // What the server adds is English, and marked so.
    expect((await problem.locator('[lang="en"]').innerText()).length).toBeGreaterThan(5);
  } finally {
    await api('/v1/sites/yard/geofence', 'PUT', { keep_in: before.keep_in, keep_out: before.keep_out });
  }
});
