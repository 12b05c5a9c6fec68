// Webhooks: one is made, tested and looked after on the page, and a receiver gets what it sends.
import { createHmac } from 'node:crypto';
import { type IncomingHttpHeaders, type Server, createServer } from 'node:http';
import type { AddressInfo } from 'node:net';
import { afterAll, beforeAll, expect, test } from 'vitest';
import { violations } from './checks';
import { browser, eventually, shot } from './harness';
import { type OwnServer, ownServer } from './own_server';

const { open } = browser();

interface Received {
  headers: IncomingHttpHeaders;
  body: string;
}

const received: Received[] = [];
/** What the receiver answers. */
let status = 204;
let receiver: Server;
let own: OwnServer;

// A server of its own, which may call this machine: the demo's may not.
beforeAll(async () => {
  receiver = createServer((request, response) => {
    let body = '';
    request.on('data', (chunk: Buffer) => (body += chunk.toString()));
    request.on('end', () => {
      received.push({ headers: request.headers, body });
      response.writeHead(status).end();
    });
  });
  await new Promise<void>((resolve) => receiver.listen(0, '127.0.0.1', resolve));
  own = await ownServer('[webhooks]\nallow_http = true\nallowed_networks = ["127.0.0.0/8"]\n');
});

afterAll(async () => {
  await own.end();
  receiver.closeAllConnections();
  receiver.close();
});

const genuine = (secret: string, { headers, body }: Received) =>
  headers['tread-signature'] === `v1=${createHmac('sha256', secret).update(`${String(headers['tread-timestamp'])}.${body}`).digest('hex')}`;

test('a webhook is made, tested, changed, disabled and removed on the page, and its deliveries are listed', async () => {
  const page = await open({ as: null, address: own.address, expected: /422/ });
  await page.getByLabel('Token').fill(own.token);
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.getByRole('tab', { name: 'Alerts' }).click();
  await page.getByText('Webhooks', { exact: true }).click();
  await page.getByRole('button', { name: 'New webhook' }).click();
  // An address that the server may not call is refused in a sentence, and what was entered stays.
  const form = page.locator('details form');
  const box = (name: string) => form.getByRole('checkbox', { name, exact: true });
  await form.getByLabel('Name', { exact: true }).fill('on call');
  await form.getByLabel('Address').fill('http://10.0.0.1/hook');
  // Kinds and sites are chosen among those that there are.
  await box('all kinds').uncheck();
  await form.getByText('Not yet: choose at least one.').waitFor();
  expect(await form.getByRole('button', { name: 'Add' }).isDisabled()).toBe(true);
  await box('No contact with the robot').check();
  await box('Mission failed').check();
  await box('all sites').uncheck();
  await box('yard').check();
  expect(await violations(page), 'the form of a webhook').toEqual([]);
  await shot(page, 'webhook-form');
  await form.getByRole('button', { name: 'Add' }).click();
  await form.locator('.problem').getByText('not public').waitFor();
  const url = `http://127.0.0.1:${(receiver.address() as AddressInfo).port}/hook`;
  await form.getByLabel('Address').fill(url);
  await form.getByRole('button', { name: 'Add' }).click();
  const note = page.locator('[data-test="secret"]');
  const secret = (await note.locator('code').innerText()).trim();
  await page.context().grantPermissions(['clipboard-read', 'clipboard-write']);
  await note.getByRole('button', { name: 'Copy' }).click();
  await note.getByText('Copied.').waitFor();
  expect(await page.evaluate(() => navigator.clipboard.readText())).toBe(secret);
  const card = page.locator('details li.card');
  await card.getByText(url).waitFor();
  await card.getByText('Mission failed, No contact with the robot · yard').waitFor();
  expect(await violations(page), 'a webhook and its secret').toEqual([]);

  const press = (name: string) => card.getByRole('button', { name, exact: true }).click();
  const newest = card.locator('.log li').first();
  await press('Log');
  await card.getByText('Nothing was sent.').waitFor();
  await press('Send a test');
  await card.getByText('The test has arrived.').waitFor();
  expect((await newest.innerText()).replace(/\s+/g, ' ')).toMatch(/ test: arrived 1 attempt, HTTP status 204$/);
  expect(received).toHaveLength(1);
  const [first] = received;
  if (!first) throw new Error('nothing was received');
  expect(genuine(secret, first)).toBe(true);
  expect(JSON.parse(first.body)).toMatchObject({ v: 1, id: null });
  await shot(page, 'webhooks');

  // Another secret, once it was asked for twice.
  await press('New secret');
  await press('Replace the secret for good');
  await eventually('another secret', async () => (await note.locator('code').innerText()).trim() !== secret);
  const next = (await note.locator('code').innerText()).trim();
  // The answer about this test is held until the next one is over.
  let release = () => {};
  const held = new Promise<void>((resolve) => (release = resolve));
  let holds = 0;
  await page.route(/\/deliveries/, async (route) => {
    const answer = await route.fetch();
    holds += 1;
    if (holds === 1) await held;
    await route.fulfill({ response: answer });
  });
  await press('Send a test');
  await eventually('the test of the new secret', async () => received.length === 2 && holds === 1);
  const [, second] = received;
  expect(second && genuine(next, second) && !genuine(secret, second)).toBe(true);
  await note.getByRole('button', { name: 'Dismiss' }).click();

  // What was set is changed, and the rest stays.
  await press('Edit');
  expect(await box('Mission failed').isChecked()).toBe(true);
  await form.getByLabel('Name', { exact: true }).fill('night shift');
  await box('all sites').check();
  await form.getByRole('button', { name: 'Save' }).click();
  await card.getByText('night shift').waitFor();
  await card.getByText('Mission failed, No contact with the robot · all sites').waitFor();

  // What the receiver refuses is sent again later, and the page says why it did not arrive, and when it is sent next.
  await eventually('the rest', async () => (await own.api<{ items: { pending: number }[] }>('/v1/webhooks')).items[0]?.pending === 0);
  status = 500;
  await press('Send a test');
  await card.getByText(/^The test has not arrived: .*500.*It is sent again\.$/).waitFor();
  // An older answer that comes now changes neither what is said of the newer test nor the log.
  const answered = page.waitForResponse(/\/deliveries/);
  release();
  await answered;
  await page.waitForTimeout(700);
  await card.getByText(/^The test has not arrived: /).waitFor();
  expect((await newest.innerText()).replace(/\s+/g, ' ')).toMatch(/ test: waits 1 attempt, HTTP status 500, next attempt \d{4}-\d\d-\d\d/);
  await press('Disable');
  await card.getByText('disabled', { exact: true }).waitFor();
  await press('Enable');
  await card.getByText('disabled', { exact: true }).waitFor({ state: 'detached' });
  await press('Remove');
  await press('Remove it with all that waits');
  await card.waitFor({ state: 'detached' });
});
