// Robots on the map move smoothly while they move, and a map on which nothing moves draws nothing.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import { planned, withApproach } from '../src/map/approach';
import type { Mission, Page as ApiPage, Robot, Stop, Trajectory, TrajectoryCheck } from './types';
import { crowd } from './crowd';
import { api, browser, eventually, select, shot } from './harness';

const { open } = browser();
const WATCHED_MS = 4_000;
/** Of ten views a second, as many come on a busy machine. */
const VIEWS_MIN_HZ = 8;
/** Frames of robots that a map may draw by chance while nothing moves. */
const IDLE_FRAMES_MAX = 2;

interface Place {
  at_ms: number;
  x: number;
  y: number;
}

/** Notes, in the page, where each robot's outline is drawn, pixels of the canvas. */
async function watchOutlines(page: Page): Promise<void> {
  await page.addInitScript(() => {
    const places: Place[] = [];
    // Each robot's outline is one of these, and nothing else on the map is.
    const outline = CanvasRenderingContext2D.prototype.roundRect;
    CanvasRenderingContext2D.prototype.roundRect = function (...words) {
      const { e, f } = this.getTransform();
      places.push({ at_ms: performance.now(), x: e, y: f });
      return outline.apply(this, words);
    };
    Object.assign(globalThis, { places });
  });
}

async function outlines(page: Page): Promise<Place[]> {
  await page.evaluate(() => ((globalThis as unknown as { places: Place[] }).places.length = 0));
  await page.waitForTimeout(WATCHED_MS);
  return page.evaluate(() => (globalThis as unknown as { places: Place[] }).places);
}

/** Places of the one outline that moves most, in order. */
function mostMoved(places: Place[]): Place[] {
  const robots: Place[][] = [];
  for (const place of places) {
    // The one that was nearest a moment ago; robots are metres apart.
    const near = robots
      .map((robot) => ({ robot, away: Math.hypot((robot.at(-1)?.x ?? 0) - place.x, (robot.at(-1)?.y ?? 0) - place.y) }))
      .sort((a, b) => a.away - b.away)[0];
    if (near && near.away < 12) near.robot.push(place);
    else robots.push([place]);
  }
  const length = (robot: Place[]) => steps(robot).reduce((sum, step) => sum + step, 0);
  return robots.sort((a, b) => length(b) - length(a))[0] ?? [];
}

function steps(places: Place[]): number[] {
  return places.slice(1).map((place, index) => Math.hypot(place.x - (places[index]?.x ?? 0), place.y - (places[index]?.y ?? 0)));
}

for (const isSelected of [true, false]) {
  const which = isSelected ? 'a robot that is selected' : 'a robot that nobody has selected';
  test(`${which} is drawn at another place at least 20 times a second, in even steps`, () => movesEvenly(isSelected));
}

async function movesEvenly(isSelected: boolean): Promise<void> {
  const sent = await api<Mission>('/v1/missions', 'POST', {
    site: 'yard',
    robot: 'rover-1',
    start_policy: 'replace',
    trajectory: { circle: { center: { x_m: 8, y_m: 6 }, radius_m: 2, speed_m_s: 0.6, turns: 20 } },
  });
  const page = await open({ prepare: watchOutlines });
  if (isSelected) await select(page, 'rover-1');
  await eventually('rover-1 is on its way', async () => {
    const robot = await api<Robot>('/v1/sites/yard/robots/rover-1');
    return (robot.live?.twist?.value.linear_m_s ?? 0) > 0.5;
  });
  const places = mostMoved(await outlines(page));
  const moved = steps(places);
  const distinct = moved.filter((step) => step > 0.01).length;
  const length_px = moved.reduce((sum, step) => sum + step, 0);
  const seconds = ((places.at(-1)?.at_ms ?? 0) - (places[0]?.at_ms ?? 0)) / 1000;
  const longest_s = Math.max(...places.slice(1).map((place, index) => place.at_ms - (places[index]?.at_ms ?? 0))) / 1000;
  // A frame that comes late makes a longer step; one that comes in time does not.
  const speeds = moved.map((step, index) => (step / ((places[index + 1]?.at_ms ?? 0) - (places[index]?.at_ms ?? 0))) * 1000);
  const sorted = [...speeds].sort((a, b) => a - b);
  const [slow, fast] = [sorted[Math.floor(sorted.length * 0.05)] ?? 0, sorted[Math.floor(sorted.length * 0.95)] ?? 0];
  console.log(
    `drawn places: ${(distinct / seconds).toFixed(1)}/s, longest frame ${(longest_s * 1000).toFixed(0)} ms, ` +
      `speed on the screen ${(length_px / seconds).toFixed(1)} px/s, 5 % ${slow.toFixed(1)}, 95 % ${fast.toFixed(1)}`,
  );
  expect(distinct / seconds).toBeGreaterThanOrEqual(20);
  expect(fast).toBeLessThan((2 * length_px) / seconds);
  await shot(page, 'motion');
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
}

test('the socket of whoever looks at a robot or drives it says ten times a second where it is', async () => {
  const page = await open();
  let views = 0;
  page.on('websocket', (socket) => {
    socket.on('framereceived', ({ payload }) => {
      if (String(payload).includes('"view"')) views += 1;
    });
  });
  const rate = async () => {
    await eventually('a first view', async () => views > 0);
    const [before, begin_ms] = [views, Date.now()];
    await page.waitForTimeout(WATCHED_MS);
    return ((views - before) / (Date.now() - begin_ms)) * 1000;
  };
  await select(page, 'rover-2');
  const watching = await rate();
  await page.getByRole('button', { name: 'Teleoperate' }).click();
  await page.getByText('You control this robot.').waitFor();
  views = 0;
  const driving = await rate();
  console.log(`views a second: ${watching.toFixed(1)} while somebody looks, ${driving.toFixed(1)} while somebody drives`);
  expect(watching).toBeGreaterThanOrEqual(VIEWS_MIN_HZ);
  expect(driving).toBeGreaterThanOrEqual(VIEWS_MIN_HZ);
});

test('robots that are selected are watched too, and no longer when they are not', async () => {
  const page = await open();
  const sockets = new Set<string>();
  page.on('websocket', (socket) => {
    const robot = /robots\/([^/]+)\/drive$/.exec(socket.url())?.[1] ?? '';
    sockets.add(robot);
    socket.on('close', () => sockets.delete(robot));
  });
  const watched = (robots: string) => eventually(`watched: ${robots}`, async () => [...sockets].sort().join() === robots);
  await page.getByLabel('Select rover-1', { exact: true }).check();
  await page.getByLabel('Select rover-3', { exact: true }).check();
  await watched('rover-1,rover-3');
  await select(page, 'rover-2');
  await watched('rover-1,rover-2,rover-3');
  await page.getByRole('button', { name: 'All robots' }).click();
  await page.getByRole('button', { name: 'Select none' }).click();
  await watched('');
});

test('of many that are selected six are watched', async () => {
  const page = await open({ prepare: (page) => crowd(page, 40) });
  const sockets: string[] = [];
  await page.routeWebSocket(/\/drive$/, (socket) => void sockets.push(socket.url()));
  await page.getByLabel('Select all 40').check();
  await eventually('six sockets', async () => sockets.length >= 6);
  await page.waitForTimeout(500);
  expect(sockets.length).toBe(6);
});

test('a map on which nothing moves draws no frames', async () => {
  const { items } = await api<ApiPage<Robot>>('/v1/sites/yard/robots');
  const page = await open({ prepare: watchOutlines });
  const stops: Stop[] = [];
  try {
    for (const { id } of items) stops.push(await api<Stop>(`/v1/sites/yard/robots/${id}/stop`, 'POST', {}));
    await eventually('every robot stands, and is drawn so', async () => {
      const robots = (await api<ApiPage<Robot>>('/v1/sites/yard/robots')).items;
      return robots.every(({ live }) => Math.abs(live?.twist?.value.linear_m_s ?? 1) < 0.005);
    });
    const frames = await eventually('a map that is at rest', async () => {
      const count = (await outlines(page)).length / items.length;
      if (count > IDLE_FRAMES_MAX) throw new Error(`${count} frames`);
      return { count };
    });
    console.log(`frames of a map at rest in ${WATCHED_MS / 1000} s: ${frames.count}`);
  } finally {
    for (const { id, robot } of stops) {
      await eventually(`${robot} is cleared`, async () => {
        await api(`/v1/sites/yard/robots/${robot}/stop/clear`, 'POST', { stop: id });
        return true;
      });
    }
  }
});

test('the approach of a path is dashed, what was asked for is not', async () => {
  const trajectories = {
    circle: { circle: { center: { x_m: 16, y_m: 18 }, radius_m: 2, speed_m_s: 0.5, turns: 2 } },
    waypoints: { waypoints: { points: [{ x_m: 12, y_m: 5 }, { x_m: 15, y_m: 7 }, { x_m: 18, y_m: 4 }], speed_m_s: 0.5 } },
  };
  // What the page finds of a mission is what a dry run states.
  for (const trajectory of Object.values(trajectories) as unknown as Trajectory[]) {
    const check = await api<TrajectoryCheck>('/v1/trajectories/check', 'POST', { site: 'yard', robot: 'rover-2', trajectory });
    expect(check.approach_length_m).toBeGreaterThan(1);
    const stated = withApproach(check.path, check.approach_length_m).approach;
    const found = planned(check.path, trajectory, check.length_m).approach;
    expect(Math.abs(found - stated)).toBeLessThanOrEqual(1);
  }
  const sent = await api<Mission>('/v1/missions', 'POST', {
    site: 'yard',
    robot: 'rover-2',
    start_policy: 'replace',
    trajectory: trajectories.circle,
  });
  // Dashes and colour of each line that the map strokes.
  const page = await open({
    async prepare(page) {
      await page.addInitScript(() => {
        const strokes = new Set<string>();
        const stroke = CanvasRenderingContext2D.prototype.stroke;
        CanvasRenderingContext2D.prototype.stroke = function (this: CanvasRenderingContext2D, ...words: unknown[]) {
          strokes.add(`${String(this.strokeStyle)} ${this.getLineDash().join()}`);
          return Reflect.apply(stroke, this, words);
        } as typeof stroke;
        Object.assign(globalThis, { strokes });
      });
    },
  });
  await select(page, 'rover-2');
  const strokes = () => page.evaluate(() => [...(globalThis as unknown as { strokes: Set<string> }).strokes]);
  await eventually('an approach and a path', async () => {
    const all = await strokes();
    return all.includes('#7a2e9d 3,5') && all.includes('#7a2e9d ');
  });
  await shot(page, 'approach');
  await api(`/v1/missions/${sent.id}/cancel`, 'POST');
});
