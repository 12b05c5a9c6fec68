// Stop and teleoperation, with real robots at the other end.
import { setTimeout as delay } from 'node:timers/promises';
import { expect, test } from 'vitest';
import type { Page } from 'playwright-core';
import type { Page as ApiPage, Robot, Stop } from './types';
import { agentOf, api, browser, eventually, select, shot } from './harness';

const { open } = browser();

const robot = (id: string) => api<Robot>(`/v1/sites/yard/robots/${id}`);
const speed = async (id: string) => (await robot(id)).live?.twist?.value.linear_m_s ?? 0;
const stops = async (id: string) =>
  (await api<ApiPage<Stop>>(`/v1/stops?site=yard&robot=${id}&in_force=true`)).items;

async function beginDriving(page: Page, id: string): Promise<void> {
  await select(page, id);
  await page.getByRole('button', { name: 'Teleoperate' }).click();
  await page.getByText('You control this robot.').waitFor();
}

/** How late what the server sends on the drive socket reaches the page: several commands. */
const LATE_MS = 300;

async function answersLate(page: Page): Promise<void> {
  await page.routeWebSocket(/\/drive$/, (socket) => {
    const server = socket.connectToServer();
    server.onMessage((message) => {
      setTimeout(() => socket.send(message), LATE_MS);
    });
  });
}

async function standsStill(id: string): Promise<void> {
  await eventually(`${id} stands`, async () => Math.abs(await speed(id)) < 0.02);
}

test('a stop is shown confirmed and is cleared from the page', async () => {
  const page = await open();
  await select(page, 'rover-2');
  await page.getByRole('button', { name: 'Stop rover-2' }).click();
  const shown = page.locator('[data-robot="rover-2"].held');
  await shown.waitFor();
  expect((await stops('rover-2')).length).toBe(1);
  await shot(page, 'stopped');
  await standsStill('rover-2');
  await page.getByRole('button', { name: 'Clear the stop of rover-2' }).click();
  await shown.waitFor({ state: 'detached' });
  expect(await stops('rover-2')).toEqual([]);
});

test('space on the stick stops the robot that somebody drives', async () => {
  const page = await open();
  await beginDriving(page, 'rover-2');
  await eventually('the stick has the keys', async () =>
    page.evaluate(() => document.activeElement?.getAttribute('role') === 'application'),
  );
  await page.keyboard.press('Space');
  const shown = page.locator('[data-robot="rover-2"].held');
  await shown.waitFor();
  expect((await stops('rover-2')).length).toBe(1);
  // Whoever has control of a stopped robot is shown what to do to drive.
  const panel = page.locator('[data-test="drive"]');
  await panel.getByText('The robot is stopped.', { exact: true }).waitFor();
  await panel.getByText('A stopped robot follows no command. To drive, press “Clear the stop of rover-2”').waitFor();
  expect(await page.getByText('You control this robot.').count()).toBe(0);
  await standsStill('rover-2');
  await shown.getByText(/^rover-2: stopped by .+\. The robot stands still\.$/).waitFor();
  await shot(page, 'driving-stopped');
  await page.getByRole('button', { name: 'Clear the stop of rover-2' }).click();
  await shown.waitFor({ state: 'detached' });
  await panel.getByText('You control this robot.').waitFor();
});

test('a stop that the robot has not confirmed stays red until it has', async () => {
  const page = await open();
  await select(page, 'rover-2');
  const agent = agentOf('rover-2');
  process.kill(agent, 'SIGSTOP');
  try {
    await page.keyboard.press('Alt+KeyX');
    await page.getByText('rover-2 has NOT confirmed its stop').first().waitFor();
    expect((await stops('rover-2'))[0]?.confirmed_at ?? null).toBeNull();
    await shot(page, 'unconfirmed');
  } finally {
    process.kill(agent, 'SIGCONT');
  }
  await page.locator('[data-robot="rover-2"].held').waitFor();
  await standsStill('rover-2');
  await page.getByRole('button', { name: 'Clear the stop of rover-2' }).click();
  await eventually('the clear', async () => (await stops('rover-2')).length === 0);
});

test('the shortcut stops all robots, also while somebody types', async () => {
  const page = await open();
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Radius, m').focus();
  await page.keyboard.press('Alt+Shift+KeyX');
  for (const id of ['rover-1', 'rover-2', 'rover-3']) {
    await page.locator(`[data-robot="${id}"].held`).waitFor();
  }
  await shot(page, 'all-stopped');
  for (const id of ['rover-1', 'rover-2', 'rover-3']) {
    await standsStill(id);
    await page.getByRole('button', { name: `Clear the stop of ${id}` }).click();
    await eventually(`${id} is cleared`, async () => (await stops(id)).length === 0);
  }
});

test('keys drive a robot, and a hidden tab makes it stand', async () => {
  const page = await open();
  await beginDriving(page, 'rover-2');
  await page.keyboard.down('KeyW');
  await eventually('rover-2 drives', async () => (await speed('rover-2')) > 0.2);
  await page.locator('dt:has-text("Commands’ age") + dd').filter({ hasText: /\d+ ms/ }).waitFor();
  await shot(page, 'driving');
  await page.evaluate(() => {
    Object.defineProperty(document, 'hidden', { value: true, configurable: true });
    document.dispatchEvent(new Event('visibilitychange'));
  });
  await standsStill('rover-2');
  await page.getByText('The tab was hidden: the robot stands.').waitFor();
  await page.evaluate(() => {
    Reflect.deleteProperty(document, 'hidden');
    document.dispatchEvent(new Event('visibilitychange'));
  });
  await page.keyboard.up('KeyW');
  await standsStill('rover-2');
  await page.keyboard.down('ArrowDown');
  await eventually('rover-2 drives backwards', async () => (await speed('rover-2')) < -0.1);
  await page.keyboard.up('ArrowDown');
  await standsStill('rover-2');
  await page.getByRole('button', { name: 'End teleoperation' }).click();
  await eventually('nobody has the lease', async () => !(await robot('rover-2')).live?.safety.lease);
});

test('the stick drives, and letting go, leaving the window or closing the page makes the robot stand', async () => {
  const page = await open();
  await beginDriving(page, 'rover-2');
  const stick = page.getByRole('application', { name: /stick/ });
  const push = async () => {
    await stick.scrollIntoViewIfNeeded();
    const box = await stick.boundingBox();
    if (!box) throw new Error('there is no stick');
    const middle = { x: box.x + box.width / 2, y: box.y + box.height / 2 };
    await page.mouse.move(middle.x, middle.y);
    await page.mouse.down();
    await page.mouse.move(middle.x, middle.y + box.height / 3, { steps: 3 });
    await eventually('rover-2 drives', async () => Math.abs(await speed('rover-2')) > 0.1);
  };
  await push();
  await page.mouse.up();
  await standsStill('rover-2');
  await push();
  await page.evaluate(() => window.dispatchEvent(new Event('blur')));
  await page.getByText('The window lost focus: the robot stands.').waitFor();
  await standsStill('rover-2');
  await page.mouse.up();
  await push();
  await page.close();
  await standsStill('rover-2');
});

test('a lease is refused while another has it, taken by force, and the loss is said', async () => {
  const first = await open();
  const second = await open();
  await beginDriving(first, 'rover-2');
  await select(second, 'rover-2');
  await second.getByRole('button', { name: 'Teleoperate' }).click();
  const take = second.getByRole('button', { name: /^Take over from/ });
  await take.waitFor();
  await take.click();
  await second.getByText('You control this robot.').waitFor();
  await first.getByText(/^You no longer control the robot/).waitFor();
  await second.getByRole('button', { name: 'End teleoperation' }).click();
  await first.getByText('Nobody drives.').waitFor();
  await first.getByRole('button', { name: 'Take control' }).click();
  await first.getByText('You control this robot.').waitFor();
  await first.getByRole('button', { name: 'End teleoperation' }).click();
});

test('why a lease was lost stays written when commands were under way', async () => {
  const first = await open({ prepare: answersLate });
  const second = await open();
  await beginDriving(first, 'rover-2');
  await select(second, 'rover-2');
  await second.getByRole('button', { name: 'Teleoperate' }).click();
  await second.getByRole('button', { name: /^Take over from/ }).click();
  await second.getByText('You control this robot.').waitFor();
  await first.getByText(/^You no longer control the robot/).waitFor();
  await delay(2 * LATE_MS);
  expect(await first.getByText(/^You no longer control the robot/).count()).toBe(1);
  await second.getByRole('button', { name: 'End teleoperation' }).click();
});

test('the touch stick of a phone drives too', async () => {
  const page = await open({ size: { width: 390, height: 800 }, hasTouch: true });
  await beginDriving(page, 'rover-2');
  const stick = page.getByRole('application', { name: /stick/ });
  await stick.evaluate((element) => element.scrollIntoView({ block: 'center' }));
  const box = await stick.boundingBox();
  if (!box) throw new Error('there is no stick');
  // Fingers are shown no keys.
  expect(await page.locator('.keys').isVisible()).toBe(false);
  expect(await page.locator('body').innerText()).not.toMatch(/W A S D|arrows|Alt\+|space stops/i);
  expect(await stick.getAttribute('aria-label')).toBe('Drive stick: drag');
  const touch = await page.context().newCDPSession(page);
  const at = (y: number) => [{ x: box.x + box.width / 2, y: box.y + y * box.height }];
  await touch.send('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: at(0.5) });
  await touch.send('Input.dispatchTouchEvent', { type: 'touchMove', touchPoints: at(0.15) });
  await eventually('rover-2 drives', async () => (await speed('rover-2')) > 0.1);
  await shot(page, 'phone-drive');
  await touch.send('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
  await standsStill('rover-2');
});
