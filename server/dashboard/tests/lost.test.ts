// A server that goes away and comes back.
import { expect, test } from 'vitest';
import { api, browser, eventually, line, select, shot } from './harness';

const { open } = browser();
/** How long the page may take to be half a minute without the server, milliseconds. */
const LONG_MS = 45_000;
/** How soon it is to go on when the server is back, milliseconds. */
const BACK_MAX_MS = 5_000;
/** What a browser says of a line that was cut. */
const CUT = /ERR_|Failed to load|WebSocket|CSP: none/;

test('a lost server is said, what was drawn is kept, and everything goes on when it is back', async () => {
  const wire = await line();
  const page = await open({ address: wire.address, expected: CUT });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('7.5');
  await page.getByLabel('Radius, m').fill('1.5');
  await page.getByLabel('Radius, m').press('Tab');
  await page.locator('[data-test="dry-run"]').waitFor();
  wire.cut();
  await page.getByText(/^The server has not answered since/).waitFor();
  await page.getByRole('button', { name: 'Send', exact: true }).click();
  await page.getByText('The server does not answer; what you entered is kept.').waitFor();
  await page.getByRole('button', { name: 'Stop rover-1' }).click();
  await page.getByText(/rover-1: the stop may not have arrived/).first().waitFor();
  // Nothing that was so is shown as if it were.
  await page.locator('.head .warn', { hasText: /^last known · / }).waitFor();
  await shot(page, 'lost');
  expect(await page.getByLabel('Centre x, m').inputValue()).toBe('7.5');
  wire.mend();
  await page.getByText(/^The server has not answered since/).waitFor({ state: 'hidden' });
  await page.getByText('live', { exact: true }).waitFor();
  const age = () => page.locator('.head span').last().innerText();
  await eventually('a fresh state', async () => /^online · 0\.\d s/.test(await age()));
  expect(await page.getByLabel('Centre x, m').inputValue()).toBe('7.5');
  wire.end();
});

test('after a long time without the server the page goes on by itself, and the same once more', async () => {
  const wire = await line();
  const page = await open({ address: wire.address, expected: CUT });
  const ages = page.locator('button[data-robot] .faint span').last();
  // First for long, then for a moment: waits that grow while it tries would be seen.
  for (const old of [/(^|· )[3-5]\d s$/, /(^|· )\d+(\.\d)? s$/]) {
    wire.cut();
    await page.getByText(/^The server has not answered since/).waitFor();
    await eventually('old states', async () => old.test((await ages.innerText()).trim()), LONG_MS);
    await page.locator('button[data-robot] .badge', { hasText: 'last known' }).first().waitFor();
    wire.mend();
    const mended = Date.now();
    await page.getByText('live', { exact: true }).waitFor();
    await page.locator('button[data-robot] .badge', { hasText: 'online' }).first().waitFor();
    await eventually('fresh states', async () => /(^|· )[01]\.\d s$/.test((await ages.innerText()).trim()));
    expect(Date.now() - mended).toBeLessThan(BACK_MAX_MS);
  }
  wire.end();
});

test('a driver whose line is cut is notified, and the robot stands', async () => {
  const wire = await line();
  const page = await open({ address: wire.address, expected: CUT });
  await select(page, 'rover-3');
  await page.getByRole('button', { name: 'Teleoperate' }).click();
  await page.getByText('You control this robot.').waitFor();
  wire.cut();
  await page.getByText(/^The connection is lost/).waitFor();
  await eventually('nobody has the lease', async () => {
    const robot = await api<{ live: { safety: { lease?: unknown } } }>('/v1/sites/yard/robots/rover-3');
    return !robot.live.safety.lease;
  });
  wire.end();
});

test('a token that is revoked leads back to the sign-in, and the drawing survives', async () => {
  const made = await api<{ secret: string; token: { id: string } }>('/v1/tokens', 'POST', {
    name: `short ${Date.now()}`,
    role: 'operator',
  });
  const page = await open({ as: made.secret, expected: /401/ });
  await select(page, 'rover-1');
  await page.getByRole('button', { name: 'New mission' }).click();
  await page.getByLabel('Centre x, m').fill('6.5');
  await page.getByLabel('Centre x, m').press('Tab');
  await api(`/v1/tokens/${made.token.id}`, 'DELETE');
  await page.getByText(/^Your sign-in has ended/).waitFor();
  const again = await api<{ secret: string }>('/v1/tokens', 'POST', { name: `again ${Date.now()}`, role: 'operator' });
  await page.getByLabel('Token').fill(again.secret);
  await page.getByRole('button', { name: 'Sign in' }).click();
  expect(await page.getByLabel('Centre x, m').inputValue()).toBe('6.5');
});
