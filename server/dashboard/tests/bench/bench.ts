// Draws the page's own map with a large fleet and a large friction layer, and counts frames.
import type { CellFriction, Robot } from '../../src/api/schema';
import { Camera } from '../../src/map/camera';
import { draw } from '../../src/map/draw';
import { RobotLabels } from '../../src/map/draw_robots';
import { Layer } from '../../src/map/friction';
import { TRAIL_POINTS, Tracked } from '../../src/state/tracked';

const SIDE = 1_024;
const MEASURED_MS = 4_000;

/** Time between two states of a robot, as the server passes them on, milliseconds. */
const STATE_MS = 1_000;
/** Robots drive on circles. */
const RADIUS_M = 5;
const SPEED_M_S = 0.7;

/** What a robot says at a time. */
function stateAt(index: number, at_ms: number): Robot {
  const angular_rad_s = SPEED_M_S / RADIUS_M;
  const heading_rad = index * 0.7 + (angular_rad_s * at_ms) / 1_000;
  const x_m = ((index * 37) % SIDE) + RADIUS_M * Math.sin(heading_rad);
  const y_m = ((index * 91) % SIDE) - RADIUS_M * Math.cos(heading_rad);
  const twist = { linear_m_s: SPEED_M_S, angular_rad_s };
  return {
    id: `rover-${index}`,
    name: `rover-${index}`,
    link: index % 10 === 0 ? 'offline' : 'online',
    model: { wheelbase_m: 0.28, track_width_m: 0.43, wheel_radius_m: 0.08 },
    live: {
      state_age_ms: 10,
      pose: { value: { x_m, y_m, heading_rad }, age_ms: 10 },
      twist: { value: twist, age_ms: 10 },
      safety: {},
    },
  } as unknown as Robot;
}

function robotAt(index: number, now: number): Tracked {
  const robot = stateAt(index, now);
  const { pose } = robot.live as { pose: { value: { x_m: number; y_m: number; heading_rad: number } } };
  const { heading_rad } = pose.value;
  const tracked = new Tracked(robot, now);
  tracked.trail = Array.from({ length: TRAIL_POINTS }, (_, point) => [
    pose.value.x_m - point * Math.cos(heading_rad + point / 90),
    pose.value.y_m - point * Math.sin(heading_rad + point / 60),
  ]).flat();
  return tracked;
}

function cells(): CellFriction[] {
  const kinds = Array.from({ length: 256 }, (_, kind) => ({
    theta: 0.05 + kind / 130,
    stiffness: 1 / (0.05 + kind / 130),
    std_dev: 0.002 * (kind % 50),
    newest_at: '2026-01-01T00:00:00Z',
    robots: 1,
    segments: 1 + kind,
  }));
  const all: CellFriction[] = [];
  for (let iy = 0; iy < SIDE; iy += 1) {
    for (let ix = 0; ix < SIDE; ix += 1) {
      const friction = kinds[(ix * 7 + iy * 13) % 256];
      all.push({ cell: { ix, iy }, configuration: 'bench', friction } as unknown as CellFriction);
    }
  }
  return all;
}

export interface Frames {
  frames_s: number;
  draw_p10_ms: number;
  draw_p50_ms: number;
  draw_p99_ms: number;
  layer_ms: number;
  labels: number;
  /** Places a second at which a robot that drives is drawn. */
  moves_s: number;
}

/** What is drawn: so many robots, with the friction layer or without. */
export interface Load {
  robots: number;
  withFriction: boolean;
}

async function measure({ robots, withFriction }: Load): Promise<Frames> {
  const canvas = document.querySelector('canvas');
  const context = canvas?.getContext('2d', { alpha: false });
  if (!canvas || !context) throw new Error('there is no canvas');
  const began = performance.now();
  const friction = withFriction ? new Layer(cells(), null, 1, 'theta') : null;
  const layer_ms = performance.now() - began;
  const tracked = Array.from({ length: robots }, (_, index) => robotAt(index, began));
  /** When each robot says its next state: evenly spread. */
  const due = tracked.map((_, index) => began + (STATE_MS * index) / robots);
  /** Where one of those online is drawn in each frame. */
  const places = new Set<string>();
  const camera = new Camera();
  camera.width = canvas.width;
  camera.height = canvas.height;
  camera.fit({ xMin: 0, yMin: 0, xMax: SIDE, yMax: SIDE });
  const spent: number[] = [];
  const labels = new RobotLabels();
  /** Labels of robots when they were written last, and so far in this frame. */
  let [labelled, written] = [0, 0];
  const { fillText } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
    if (/\d/.test(text) && this.textAlign === 'left') written += 1;
    fillText.call(this, text, x, y);
  };
  const start = performance.now();
  let now = start;
  while (now - start < MEASURED_MS) {
    now = await new Promise<number>((resolve) => requestAnimationFrame(resolve));
    const before = performance.now();
    if (written > 1) labelled = written;
    written = 0;
    for (const [index, one] of tracked.entries()) {
      if (now < (due[index] ?? 0)) continue;
      one.update(stateAt(index, now), now);
      due[index] = now + STATE_MS;
    }
    const { pose } = tracked[1]?.shownAt(now) ?? {};
    if (pose) places.add(`${pose.x_m} ${pose.y_m}`);
    // The ground is drawn anew in each frame.
    camera.pan(Math.sin(now / 300), Math.cos(now / 300));
    draw(context, camera, {
      terrains: [],
      fence: null,
      tracked,
      missions: [],
      unconfirmed: new Set(),
      friction,
      draft: null,
      faulty: [],
      driven: null,
      dryRun: null,
      pathOf: () => null,
      selected: 'rover-1',
      pointed: null,
      marked: new Set<string>(),
      labels,
      showTerrains: true,
      showFence: true,
      showTrails: true,
      inspected: null,
      showCross: false,
      isOld: false,
      theme: 'light',
      now,
    });
    // Reading a pixel waits until everything is really drawn.
    context.getImageData(0, 0, 1, 1);
    spent.push(performance.now() - before);
  }
  const seconds = (now - start) / 1000;
  spent.sort((a, b) => a - b);
  return {
    frames_s: spent.length / seconds,
    draw_p10_ms: spent[Math.floor(spent.length * 0.1)] ?? NaN,
    draw_p50_ms: spent[Math.floor(spent.length * 0.5)] ?? NaN,
    draw_p99_ms: spent[Math.floor(spent.length * 0.99)] ?? NaN,
    layer_ms,
    labels: labelled,
    moves_s: places.size / seconds,
  };
}

Object.assign(globalThis, { measure });
