// A server of a test's own, with robots on its sites: for what would disturb the demo fleet that all tests share.
import { type ChildProcess, execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { createServer } from 'node:net';
import type { AddressInfo } from 'node:net';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { eventually } from './harness';

export interface OwnServer {
  address: string;
  token: string;
  /** Asks its API as admin. */
  api<T>(path: string, method?: string, body?: unknown): Promise<T>;
  /** Starts a simulated robot, and waits until it is online. */
  robot(site: string, robot: string): Promise<void>;
  /** Ends the agent of a robot, as a crash would. */
  kill(site: string, robot: string): Promise<void>;
  end(): Promise<void>;
}

async function freePort(): Promise<number> {
  const holder = createServer();
  await new Promise<void>((resolve) => holder.listen(0, '127.0.0.1', resolve));
  const { port } = holder.address() as AddressInfo;
  await new Promise((resolve) => holder.close(resolve));
  return port;
}

async function ended(child: ChildProcess, signal: NodeJS.Signals): Promise<void> {
  if (child.exitCode !== null || child.signalCode !== null) return;
  const exit = new Promise((resolve) => child.once('exit', resolve));
  child.kill(signal);
  await exit;
}

/** Starts a server with one site, `yard`, and with what else its configuration says. */
export async function ownServer(config = ''): Promise<OwnServer> {
  const folder = mkdtempSync(join(tmpdir(), 'tread-own-'));
  const program = process.env['TREAD_BIN'] ?? '';
  const [http, zenoh] = [await freePort(), await freePort()];
  const [settings, database] = [join(folder, 'server.toml'), join(folder, 'tread.db')];
  writeFileSync(settings, config);
  execFileSync(program, ['server', 'init', '--force', '--name=admin', `--database=${database}`, `--token-file=${join(folder, 'token')}`]);
  const flags = [`--config=${settings}`, `--database=${database}`, `--http=127.0.0.1:${http}`, `--zenoh=127.0.0.1:${zenoh}`, '--site=yard'];
  const server = spawn(program, ['server', ...flags], { stdio: 'ignore' });
  const agents = new Map<string, ChildProcess>();
  const address = `http://127.0.0.1:${http}`;
  const token = readFileSync(join(folder, 'token'), 'utf8').trim();
  await eventually('the server', async () => (await fetch(`${address}/readyz`)).ok);
  const api = async <T>(path: string, method = 'GET', body?: unknown): Promise<T> => {
    const answer = await fetch(`${address}${path}`, {
      method,
      headers: { authorization: `Bearer ${token}`, 'content-type': 'application/json' },
      ...(body === undefined ? {} : { body: JSON.stringify(body) }),
    });
    const text = await answer.text();
    if (!answer.ok) throw new Error(`${method} ${path}: ${answer.status} ${text}`);
    return (text ? JSON.parse(text) : undefined) as T;
  };
  return {
    address,
    token,
    api,
    async robot(site, robot) {
      const flags = [`--site=${site}`, `--robot=${robot}`, `--server=tcp/127.0.0.1:${zenoh}`, `--data-dir=${join(folder, site, robot)}`, '--start=4,4,0'];
      agents.set(`${site}/${robot}`, spawn(program, ['agent', ...flags], { stdio: 'ignore' }));
      await eventually(`${robot} of ${site} is online`, async () => {
        return (await api<{ link: string }>(`/v1/sites/${site}/robots/${robot}`)).link === 'online';
      });
    },
    async kill(site, robot) {
      const agent = agents.get(`${site}/${robot}`);
      if (agent) await ended(agent, 'SIGKILL');
    },
    async end() {
      for (const agent of agents.values()) await ended(agent, 'SIGTERM');
      await ended(server, 'SIGTERM');
      rmSync(folder, { recursive: true, force: true });
    },
  };
}
