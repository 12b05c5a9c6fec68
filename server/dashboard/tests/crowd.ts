// A fleet of hundreds of robots for the page: its stream of events is made here, everything else is the server's.
import type { Page } from 'playwright-core';
import type { Robot } from './types';
import { api } from './harness';

/** Robots of the crowd in trouble: some of each kind, the same each time. */
export const CROWD = { fault: 4, lost: 10, stopped: 20, moving: 150 } as const;

/** Puts a crowd in the place of the robots of the stream, before the page is opened. */
export async function crowd(page: Page, count: number): Promise<void> {
  const { items } = await api<{ items: Robot[] }>('/v1/sites/yard/robots');
  const model = items.find((robot) => robot.live?.pose);
  if (!model) throw new Error('no robot says where it is');
  await page.addInitScript(
    ({ model, count, kinds }) => {
      type Listener = (event: { data: string }) => void;
      const side = Math.ceil(Math.sqrt(count));
      const robotAt = (index: number, time: number) => {
        const robot = structuredClone(model);
        const { fault, lost, stopped, moving } = kinds;
        const kind = [fault, fault + lost, fault + lost + stopped, fault + lost + stopped + moving].findIndex(
          (end) => index < end,
        );
        // Names say nothing of what a robot does.
        const number = ((index * 37) % count) + 1;
        robot.id = `crowd-${number}`;
        robot.name = `crowd-${number}`;
        robot.link = kind === 1 ? 'offline' : 'online';
        robot.alerts = [];
        const live = robot.live;
        if (!live?.pose) return robot;
        live.mode = (['fault', 'idle', 'stopped', 'tracking'] as const)[kind] ?? 'idle';
        live.fault = kind === 0 ? 'a motor is too hot' : null;
        live.heard_age_ms = 20;
        live.mission = null;
        Object.assign(live.safety, { stop: null, standing: null });
        const wander = kind === 3 ? 0.3 * Math.sin(time / 900 + index) : 0;
        const heading_rad = index * 0.7 + wander;
        live.pose.value = {
          ...live.pose.value,
          x_m: (index % side) * 1.6 + wander,
          y_m: Math.floor(index / side) * 1.2,
          heading_rad,
        };
        return robot;
      };
      class Crowd {
        static readonly CLOSED = 2;
        readonly CLOSED = 2;
        readyState = 1;
        onopen: (() => void) | null = null;
        onerror: (() => void) | null = null;
        #listeners = new Map<string, Listener>();
        #timer: ReturnType<typeof setInterval>;
        #next = 0;
        constructor() {
          setTimeout(() => {
            this.onopen?.();
            this.#say('snapshot_begin', 'snapshot_begin');
            for (let index = 0; index < count; index += 1) this.#robot(index);
            this.#say('snapshot_end', 'snapshot_end');
          });
          // Each robot says something twice a second, spread over time.
          this.#timer = setInterval(() => {
            for (let many = Math.ceil(count / 25); many > 0; many -= 1) this.#robot(this.#next++ % count);
          }, 20);
        }
        #robot(index: number) {
          this.#say('robot', { robot: robotAt(index, performance.now()) });
        }
        #say(name: string, sent: unknown) {
          this.#listeners.get(name)?.({ data: JSON.stringify(sent) });
        }
        addEventListener(name: string, listener: Listener) {
          this.#listeners.set(name, listener);
        }
        close() {
          this.readyState = 2;
          clearInterval(this.#timer);
        }
      }
      Object.assign(globalThis, { EventSource: Crowd });
    },
    { model, count, kinds: CROWD },
  );
}
