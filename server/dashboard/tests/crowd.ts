// A fleet of hundreds of robots for the page: its stream of events is made here, everything else is the server's.
import type { Page } from 'playwright-core';
import type { Robot } from './types';
import { api } from './harness';

/** Robots of the crowd in trouble: some of each kind, the same each time. The others are idle. */
export const CROWD = { fault: 4, lost: 10, stopped: 20, moving: 150 } as const;

/** Side of the place that each robot has for itself, metres. */
const PLACE_M = { x: 1.6, y: 1.2 };
/** The circle on which a robot that moves drives, and how fast. */
const CIRCLE = { radius_m: 0.4, angular_rad_s: 1 };
/** Numbers that stand in a robot's text where those of its pose belong. */
const X = 111_111.5;
const Y = 222_222.5;
const HEADING = 333_333.5;

/** What a robot says, as text around the numbers of its pose, so that saying it costs the page nothing. */
interface Words {
  parts: string[];
  x_m: number;
  y_m: number;
  heading_rad: number;
  isMoving: boolean;
}

function wordsOf(
  model: Robot,
  index: number,
  count: number,
  kinds: Record<keyof typeof CROWD, number>,
  change: (robot: Robot) => void,
): Words {
  const robot = structuredClone(model);
  const ends = [kinds.fault, kinds.lost, kinds.stopped, kinds.moving].map((_, kind, all) =>
    all.slice(0, kind + 1).reduce((sum, many) => sum + many, 0),
  );
  const kind = ends.findIndex((end) => index < end);
  // Names say nothing of what a robot does.
  const number = ((index * 37) % count) + 1;
  const isMoving = kind === 3;
  const side = Math.ceil(Math.sqrt(count));
  Object.assign(robot, { id: `crowd-${number}`, name: `crowd-${number}`, link: kind === 1 ? 'offline' : 'online', alerts: [] });
  const { live } = robot;
  if (!live?.pose || !live.twist) throw new Error('the model does not say where it is');
  live.mode = (['fault', 'idle', 'stopped', 'tracking'] as const)[kind] ?? 'idle';
  live.fault = kind === 0 ? 'a motor is too hot' : null;
  live.state_age_ms = 20;
  live.mission = null;
  Object.assign(live.safety, { stop: null, standstill: null });
  Object.assign(live.pose, { value: { ...live.pose.value, x_m: X, y_m: Y, heading_rad: HEADING }, age_ms: 20 });
  live.twist.value = {
    linear_m_s: isMoving ? CIRCLE.radius_m * CIRCLE.angular_rad_s : 0,
    angular_rad_s: isMoving ? CIRCLE.angular_rad_s : 0,
  };
  change(robot);
  return {
    parts: JSON.stringify({ robot }).split(new RegExp(`${X}|${Y}|${HEADING}`)),
    x_m: (index % side) * PLACE_M.x,
    y_m: Math.floor(index / side) * PLACE_M.y,
    heading_rad: index * 0.7,
    isMoving,
  };
}

/** Puts a crowd in the place of the robots of the stream, before the page is opened; `change` alters each of its robots. */
export async function crowd(
  page: Page,
  count: number,
  kinds: Record<keyof typeof CROWD, number> = CROWD,
  change: (robot: Robot) => void = () => undefined,
): Promise<void> {
  // The server knows none of them: nothing is behind the sockets that watch them.
  await page.routeWebSocket(/\/drive$/, () => undefined);
  const { items } = await api<{ items: Robot[] }>('/v1/sites/yard/robots');
  const model = items.find((robot) => robot.live?.pose && robot.live.twist);
  if (!model) throw new Error('no robot says where it is');
  const words = Array.from({ length: count }, (_, index) => wordsOf(model, index, count, kinds, change));
  if (words.some(({ parts }) => parts.length !== 4)) throw new Error('a pose is not where it was looked for');
  await page.addInitScript(
    ({ words, circle: { radius_m, angular_rad_s } }) => {
      type Listener = (event: { data: string }) => void;
      const said = ({ parts, x_m, y_m, heading_rad, isMoving }: Words, time_s: number) => {
        const heading = heading_rad + (isMoving ? angular_rad_s * time_s : 0);
        const x = x_m + (isMoving ? radius_m * Math.sin(heading) : 0);
        const y = y_m - (isMoving ? radius_m * Math.cos(heading) : 0);
        return `${parts[0]}${x}${parts[1]}${y}${parts[2]}${heading}${parts[3]}`;
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
            this.#say('snapshot_begin', '"snapshot_begin"');
            for (const one of words) this.#robot(one);
            this.#say('snapshot_end', '"snapshot_end"');
          });
          // Each robot says something twice a second, spread over time.
          this.#timer = setInterval(() => {
            for (let many = Math.ceil(words.length / 25); many > 0; many -= 1) {
              const one = words[this.#next++ % words.length];
              if (one) this.#robot(one);
            }
          }, 20);
        }
        #robot(one: Words) {
          this.#say('robot', said(one, (performance.now() - 20) / 1000));
        }
        #say(name: string, data: string) {
          this.#listeners.get(name)?.({ data });
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
    { words, circle: CIRCLE },
  );
}
