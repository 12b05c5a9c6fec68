// Where alerts are sent: a webhook is made, tested and looked after on the page, and a receiver gets what it sends.
import { type ChildProcess, execFileSync, spawn } from 'node:child_process';
import { createHmac } from 'node:crypto';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { type IncomingHttpHeaders, type Server, createServer } from 'node:http';
import type { AddressInfo } from 'node:net';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { afterAll, beforeAll, expect, test } from 'vitest';
import { violations } from './checks';
import { browser, eventually, shot } from './harness';

const { open } = browser();

interface Received {
  headers: IncomingHttpHeaders;
  body: string;
}

const received: Received[] = [];
/** What the receiver answers. */
let status = 204;
let folder: string;
let receiver: Server;
let server: ChildProcess;
let address: string;

/** Listens at a free port of this machine. */
function listening(server: Server): Promise<number> {
  return new Promise((resolve) => server.listen(0, '127.0.0.1', () => resolve((server.address() as AddressInfo).port)));
}

async function freePort(): Promise<number> {
  const holder = createServer();
  const port = await listening(holder);
  await new Promise((resolve) => holder.close(resolve));
  return port;
}

// A server of its own, which may call this machine: the demo's may not.
beforeAll(async () => {
  folder = mkdtempSync(join(tmpdir(), 'tread-webhooks-'));
  receiver = createServer((request, response) => {
    let body = '';
    request.on('data', (chunk: Buffer) => (body += chunk.toString()));
    request.on('end', () => {
      received.push({ headers: request.headers, body });
      response.writeHead(status).end();
    });
  });
  await listening(receiver);
  const program = process.env['TREAD_BIN'] ?? '';
  const [http, zenoh] = [await freePort(), await freePort()];
  const config = join(folder, 'server.toml');
  const database = join(folder, 'tread.db');
  writeFileSync(config, '[webhooks]\nallow_http = true\nallowed_networks = ["127.0.0.0/8"]\n');
  execFileSync(program, ['server', 'init', '--force', '--name=admin', `--database=${database}`, `--token-file=${join(folder, 'token')}`]);
  const flags = [`--config=${config}`, `--database=${database}`, `--http=127.0.0.1:${http}`, `--zenoh=127.0.0.1:${zenoh}`];
  server = spawn(program, ['server', ...flags], { stdio: 'ignore' });
  address = `http://127.0.0.1:${http}`;
  await eventually('the server', async () => (await fetch(`${address}/readyz`)).ok);
});

afterAll(async () => {
  const ended = new Promise((resolve) => server.once('exit', resolve));
  server.kill('SIGTERM');
  await ended;
  receiver.closeAllConnections();
  receiver.close();
  rmSync(folder, { recursive: true, force: true });
});

test('a webhook is made, tested, disabled and removed on the page, and its deliveries are listed', async () => {
  const page = await open({ as: null, address, expected: /422/ });
  const admin = readFileSync(join(folder, 'token'), 'utf8').trim();
  await page.getByLabel('Token').fill(admin);
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.getByRole('tab', { name: 'Alerts' }).click();
  await page.getByText('Where alerts are sent').click();
  // An address that the server may not call is refused in a sentence.
  const form = page.locator('details form');
  const add = async (url: string) => {
    await form.getByLabel('Name').fill('on call');
    await form.getByLabel('Address').fill(url);
    await form.getByLabel('Kinds').fill('robot-lost, mission-failed');
    await form.getByLabel('Sites').fill('yard');
    await form.getByRole('button', { name: 'Add' }).click();
  };
  await add('http://10.0.0.1/hook');
  await page.locator('details .problem').getByText('not public').waitFor();
  const url = `http://127.0.0.1:${(receiver.address() as AddressInfo).port}/hook`;
  await add(url);
  const secret = (await page.locator('details .note code').innerText()).trim();
  const card = page.locator('details li.card');
  await card.getByText(url).waitFor();
  await card.getByText('mission-failed, robot-lost').waitFor();
  await card.getByText('yard', { exact: true }).waitFor();
  expect(await violations(page), 'a webhook and its secret').toEqual([]);

  const press = (name: string) => card.getByRole('button', { name, exact: true }).click();
  const lines = card.locator('li');
  const newest = async (says: RegExp) =>
    eventually(`a delivery that ${says}`, async () => {
      await press('Log');
      return (await lines.count()) > 0 && says.test(await lines.first().innerText());
    });
  await press('Log');
  await card.getByText('Nothing was sent.').waitFor();
  await press('Send a test');
  await newest(/arrived/);
  expect(received).toHaveLength(1);
  const { headers, body } = received[0] ?? { headers: {}, body: '' };
  const signed = createHmac('sha256', secret).update(`${String(headers['tread-timestamp'])}.${body}`).digest('hex');
  expect(headers['tread-signature']).toBe(`v1=${signed}`);
  expect(JSON.parse(body)).toMatchObject({ v: 1, id: null });
  await shot(page, 'webhooks');

  // What the receiver refuses is sent again later, and the page says why it did not arrive.
  status = 500;
  await press('Send a test');
  await newest(/waits.*500/s);
  await press('Disable');
  await card.getByText('disabled', { exact: true }).waitFor();
  await press('Enable');
  await card.getByText('disabled', { exact: true }).waitFor({ state: 'detached' });
  page.once('dialog', (dialog) => void dialog.accept());
  await press('Remove');
  await card.waitFor({ state: 'detached' });
});
