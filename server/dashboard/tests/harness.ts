// A browser on the page, the API beside it, and waiting for states with a bound.
import { execFileSync } from 'node:child_process';
import { existsSync, mkdirSync, readFileSync } from 'node:fs';
import { type Socket, connect, createServer } from 'node:net';
import type { AddressInfo } from 'node:net';
import { type Browser, type BrowserContext, type Locator, type Page, chromium } from 'playwright-core';
import { afterAll, afterEach, beforeAll, expect, inject } from 'vitest';

/** How long anything may take to come about, milliseconds. */
export const PATIENCE_MS = 25_000;
const LOOK_AGAIN_MS = 50;
/** Screenshots are kept here, to be looked at. */
const SHOTS = new URL('../shots/', import.meta.url).pathname;

/** What tests find in the browser's storage, unless they want something else. */
const KEPT = { 'tread-units': 'metric', 'tread-guide': 'closed' } as const;

export const server = (): string => inject('server');
export const token = (): string => inject('token');

/** Asks the API as admin, past the page. */
export async function api<T>(path: string, method = 'GET', body?: unknown): Promise<T> {
  const answer = await fetch(`${server()}${path}`, {
    method,
    headers: { authorization: `Bearer ${token()}`, 'content-type': 'application/json' },
    ...(body === undefined ? {} : { body: JSON.stringify(body) }),
  });
  const text = await answer.text();
  if (!answer.ok) throw new Error(`${method} ${path}: ${answer.status} ${text}`);
  return (text ? JSON.parse(text) : undefined) as T;
}

/** Waits until a look gives something, and says what was seen last if it never does. */
export async function eventually<T>(
  what: string,
  look: () => Promise<T | null | undefined | false>,
  patienceMs = PATIENCE_MS,
): Promise<T> {
  const end = Date.now() + patienceMs;
  let last: unknown;
  while (Date.now() < end) {
    try {
      const found = await look();
      if (found) return found;
      last = found;
    } catch (error) {
      last = error;
    }
    await new Promise((resolve) => setTimeout(resolve, LOOK_AGAIN_MS));
  }
  throw new Error(`not within ${patienceMs} ms: ${what}; last seen: ${String(last)}`);
}

/** A browser for a file of tests; everything that its consoles say amiss fails the file. */
export function browser(): { open(options?: Open): Promise<Page> } {
  let running: Browser;
  const contexts = new Set<BrowserContext>();
  const amiss: string[] = [];
  beforeAll(async () => {
    mkdirSync(SHOTS, { recursive: true });
    running = await chromium.launch({
      executablePath: inject('chromium'),
      // A page that was put in the place of the embedded one comes from nowhere, for Chromium.
      args: ['--no-sandbox', '--disable-gpu'].concat(
        process.env['TREAD_DIST'] ? ['--disable-features=LocalNetworkAccessChecks'] : [],
      ),
    });
  });
  // A page that is no longer needed would go on drawing its robots.
  afterEach(async () => {
    for (const context of contexts) {
      // An answer that a test replaces may be on its way; closing makes its handler throw.
      for (const page of context.pages()) await page.unrouteAll({ behavior: 'ignoreErrors' });
      await context.close();
    }
    contexts.clear();
  });
  afterAll(async () => {
    await running.close();
    expect(amiss).toEqual([]);
  });
  return {
    async open(options: Open = {}): Promise<Page> {
      const context = await running.newContext({
        viewport: options.size ?? { width: 1360, height: 850 },
        colorScheme: options.theme ?? 'light',
        hasTouch: options.hasTouch ?? false,
        // Tests find things by their English names, whatever the machine speaks.
        locale: options.locale ?? 'en-US',
      });
      contexts.add(context);
      const page = await context.newPage();
      page.setDefaultTimeout(PATIENCE_MS);
      await page.addInitScript(() => {
        document.addEventListener('securitypolicyviolation', (event) =>
          console.error(`CSP: ${event.violatedDirective} ${event.blockedURI}`),
        );
      });
      // What this browser keeps from before, unless something else was chosen since.
      const kept = { ...KEPT, ...options.kept };
      await page.addInitScript((kept) => {
        for (const [key, value] of Object.entries(kept)) {
          if (value !== null && localStorage.getItem(key) === null) localStorage.setItem(key, value);
        }
      }, kept);
      page.on('pageerror', (error) => amiss.push(error.message));
      page.on('console', (message) => {
        const text = message.text();
        // What was asked for is not in the text of a refused request.
        if (message.type() === 'error' && !options.expected?.test(text)) amiss.push(`${text} (${message.location().url})`);
      });
      if (process.env['TREAD_DIST']) await fromDisk(page, process.env['TREAD_DIST']);
      if (options.prepare) await options.prepare(page);
      await page.goto(options.address ?? server());
      if (options.as !== null) await signIn(page, options.as ?? token());
      return page;
    },
  };
}

/** Puts a page that was just built in the place of the embedded one, with its headers. */
async function fromDisk(page: Page, folder: string): Promise<void> {
  await page.route(/\/(page\/.*)?$/, async (route) => {
    const name = new URL(route.request().url()).pathname.replace(/^\/(page\/)?/, '') || 'index.html';
    const path = `${folder}/${name}`;
    if (!existsSync(path)) return route.continue();
    const response = await route.fetch();
    return route.fulfill({ response, body: readFileSync(path) });
  });
}

export interface Open {
  /** The token to sign in with; null for nobody. */
  as?: string | null;
  address?: string;
  size?: { width: number; height: number };
  theme?: 'light' | 'dark';
  hasTouch?: boolean;
  /** What the browser asks for. */
  locale?: string;
  /** What the browser's storage has from before; null for nothing. */
  kept?: Partial<Record<keyof typeof KEPT, string | null>>;
  /** What the console may say, since the test makes it happen. */
  expected?: RegExp;
  prepare?(page: Page): Promise<void>;
}

export async function signIn(page: Page, secret: string): Promise<void> {
  await page.locator('input[name="token"]').fill(secret);
  await page.locator('form button.main').click();
  await page.locator('button[data-robot]').first().waitFor();
}

export async function shot(page: Page, name: string): Promise<void> {
  await page.screenshot({ path: `${SHOTS}${name}.png` });
}

export async function select(page: Page, robot: string): Promise<void> {
  await page.getByRole('tab', { name: 'Robots' }).click();
  const back = page.getByRole('button', { name: 'All robots' });
  if (await back.isVisible()) await back.click();
  await page.locator(`button[data-robot="${robot}"]`).click();
}

/** The process of a robot's agent: one of the demo's children. */
export function agentOf(id: string): number {
  const children = execFileSync('pgrep', ['-P', String(inject('demoPid'))], { encoding: 'utf8' });
  for (const pid of children.trim().split('\n').map(Number)) {
    const words = readFileSync(`/proc/${pid}/cmdline`, 'utf8').split('\0');
    if (words.includes('agent') && words.some((word) => word.includes(id))) return pid;
  }
  throw new Error(`no agent of ${id} among ${children}`);
}

/** Pixels of a canvas that have just this colour. */
export function inked(canvas: Locator, [red, green, blue]: readonly number[]): Promise<number> {
  return canvas.evaluate(
    (drawn: HTMLCanvasElement, ink) => {
      const { data } = drawn.getContext('2d')!.getImageData(0, 0, drawn.width, drawn.height);
      let count = 0;
      for (let at = 0; at < data.length; at += 4) {
        if (data[at] === ink[0] && data[at + 1] === ink[1] && data[at + 2] === ink[2]) count += 1;
      }
      return count;
    },
    [red, green, blue],
  );
}

/** The map's canvas and where it lies. */
export async function map(page: Page): Promise<{ x: number; y: number; width: number; height: number }> {
  const box = await page.getByRole('application', { name: /^Map/ }).boundingBox();
  if (!box) throw new Error('there is no map');
  return box;
}

/** Metres under a place of the window, as the page reads them out. */
export async function metresAt(page: Page, x: number, y: number): Promise<{ x_m: number; y_m: number }> {
  await page.mouse.move(x, y);
  const text = await page.locator('output.cursor').innerText();
  const found = /x (-?[\d.]+) m, y (-?[\d.]+) m/.exec(text);
  if (!found) throw new Error(`no place in \`${text}\``);
  return { x_m: Number(found[1]), y_m: Number(found[2]) };
}

/** Where some metres lie in the window: the map is linear. */
export async function windowOf(page: Page): Promise<(x_m: number, y_m: number) => { x: number; y: number }> {
  const box = await map(page);
  const [left, top] = [box.x + 150, box.y + 200];
  const [right, bottom] = [box.x + box.width - 250, box.y + box.height - 100];
  const a = await metresAt(page, left, top);
  const b = await metresAt(page, right, bottom);
  return (x_m, y_m) => ({
    x: left + ((x_m - a.x_m) / (b.x_m - a.x_m)) * (right - left),
    y: top + ((y_m - a.y_m) / (b.y_m - a.y_m)) * (bottom - top),
  });
}

/** A line to the server that can be cut, and mended. */
export async function line(): Promise<{ address: string; cut(): void; mend(): void; end(): void }> {
  const to = new URL(server());
  const sockets = new Set<Socket>();
  let isCut = false;
  const keep = (socket: Socket) => {
    sockets.add(socket);
    socket.on('error', () => socket.destroy());
    socket.on('close', () => sockets.delete(socket));
  };
  const listener = createServer((near) => {
    keep(near);
    if (isCut) {
      near.destroy();
      return;
    }
    const far = connect(Number(to.port), to.hostname);
    keep(far);
    near.pipe(far).pipe(near);
    near.on('close', () => far.destroy());
    far.on('close', () => near.destroy());
  });
  await new Promise<void>((resolve) => listener.listen(0, '127.0.0.1', resolve));
  return {
    address: `http://127.0.0.1:${(listener.address() as AddressInfo).port}`,
    cut() {
      isCut = true;
      for (const socket of sockets) socket.destroy();
    },
    mend() {
      isCut = false;
    },
    end() {
      for (const socket of sockets) socket.destroy();
      listener.close();
    },
  };
}
