// One demo fleet for all tests of the page: a server and three simulated robots.
import { type ChildProcess, execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import type { TestProject } from 'vitest/node';

declare module 'vitest' {
  interface ProvidedContext {
    server: string;
    token: string;
    demoPid: number;
    chromium: string;
  }
}

/** How long the fleet may take until it is there, milliseconds. */
const START_MAX_MS = 60_000;
/** How much of the demo's output is kept, characters. */
const OUTPUT_MAX = 20_000;

function needed(name: string, hint: string): string {
  const value = process.env[name];
  if (!value) throw new Error(`${name} is not set: ${hint}`);
  return value;
}

function chromiumPath(): string {
  for (const name of [process.env['CHROMIUM'], 'chromium', 'chromium-browser', 'google-chrome']) {
    if (!name) continue;
    try {
      return execFileSync('which', [name], { encoding: 'utf8' }).trim();
    } catch {
      // The next name.
    }
  }
  throw new Error('no Chromium: install the package `chromium`, or name one in CHROMIUM');
}

export default async function setup(project: TestProject): Promise<() => Promise<void>> {
  const chromium = chromiumPath();
  const program = needed('TREAD_BIN', 'the path of the built `tread`');
  const folder = mkdtempSync(join(tmpdir(), 'tread-page-'));
  const demo = spawn(program, ['demo', '--port', '8470', '--data-dir', folder], {
    stdio: ['ignore', 'pipe', 'pipe'],
  });
  const server = await address(demo);
  // If the demo ends, all tests that follow fail; its output says why.
  let output = '';
  for (const stream of [demo.stdout, demo.stderr]) {
    stream?.on('data', (chunk: Buffer) => (output = (output + chunk.toString()).slice(-OUTPUT_MAX)));
  }
  const report = (code: number | null, signal: string | null) =>
    console.error(`the demo ended during the tests with ${code ?? signal}; its output:\n${output}`);
  demo.once('close', report);
  project.provide('server', server);
  project.provide('token', readFileSync(join(folder, 'admin.token'), 'utf8').trim());
  project.provide('demoPid', demo.pid ?? 0);
  project.provide('chromium', chromium);
  return async () => {
    demo.off('close', report);
    if (demo.exitCode === null && demo.signalCode === null) {
      const ended = new Promise((resolve) => demo.once('exit', resolve));
      demo.kill('SIGINT');
      await ended;
    }
    rmSync(folder, { recursive: true, force: true });
  };
}

/** Waits until the demo says where its server is, with all robots there. */
function address(demo: ChildProcess): Promise<string> {
  return new Promise((resolve, reject) => {
    let said = '';
    const fail = (why: string) => reject(new Error(`${why}; the demo said:\n${said}`));
    const timer = setTimeout(() => fail('no fleet in time'), START_MAX_MS);
    const read = (chunk: Buffer) => {
      said += chunk.toString();
      const found = /REST API\s+(http:\/\/[^/\s]+)\/v1/.exec(said);
      if (!found?.[1] || !said.includes('missions sent')) return;
      clearTimeout(timer);
      resolve(found[1]);
    };
    demo.stdout?.on('data', read);
    demo.stderr?.on('data', read);
    demo.once('exit', () => fail('the demo ended'));
  });
}
