// Draws the map, layer by layer. Knows nothing of the page: what to draw comes in a scene.
import type { Cell, Geofence, Mission, Terrain, Trajectory } from '../api/schema';
import type { Tracked } from '../state/tracked';
import type { Theme } from '../state/session.svelte';
import { texts } from '../texts';
import { scaleBar, stepM } from '../units';
import type { Camera, PointM } from './camera';
import type { Planned } from './approach';
import type { Draft } from './draft';
import { HATCHED_CELL_PX, drawFriction, drawInspected } from './draw_friction';
import { drawRobots, type RobotLabels } from './draw_robots';
import type { Raster } from './raster';
import type { Moment } from './replay';
import { PALETTES, groundFill, groundLine, type Palette } from './palette';

export { HATCHED_CELL_PX };

export interface Scene {
  terrains: Terrain[];
  fence: Geofence | null;
  tracked: Iterable<Tracked>;
  missions: Mission[];
  /** Robots whose stop is not confirmed, or has failed. */
  unconfirmed: ReadonlySet<string>;
  friction: Raster<{ cell: Cell }> | null;
  draft: Draft | null;
  /** Points of the draft that are at fault, by their numbers in the table, from 1. */
  faulty: readonly number[];
  /** The mission that is looked at: its path as it was planned, as far as that is known, and driven. */
  driven: { asked: Trajectory; planned: Planned | null; points: PointM[]; moment: Moment | null } | null;
  /** The smooth path of what is drawn, by its dry run; null without one. */
  dryRun: Planned | null;
  /** The smooth path of a mission, once it is known. */
  pathOf(mission: Mission): Planned | null;
  selected: string | null;
  /** The robot that is pointed at, on the map or in the list. */
  pointed: string | null;
  /** Where labels of robots stood in the frame before. */
  labels: RobotLabels;
  /** Robots that are selected with others. */
  marked: ReadonlySet<string>;
  showTerrains: boolean;
  showFence: boolean;
  showTrails: boolean;
  /** The place of the friction map that is looked at. */
  inspected: PointM | null;
  /** Marks the middle, for those who draw or read by keys. */
  showCross: boolean;
  /** The server is lost: what is shown was so when it was heard last. */
  isOld: boolean;
  theme: Theme;
  /** Monotonic, milliseconds. */
  now: number;
}

/** Least pixels between two lines of the grid. */
const GRID_PX = 48;
/** Width that the scale bar aims at, pixels. */
const SCALE_BAR_PX = 90;
/** Dashes of the approach to a path, pixels. */
export const APPROACH_DASH = [3, 5];
/** Dashes of a path that was planned, below the one that was driven, pixels. */
export const PLANNED_DASH = [8, 5];
/** Radius of the ring around a point that is at fault, pixels. */
const FAULTY_PX = 12;
/** What stays free around the text and the line of the scale bar, pixels. */
const SCALE_BAR_MARGIN_PX = 6;
/** Length of the arrow of a moment, pixels from its middle. */
const MOMENT_PX = 11;

/** Draws everything; true while a robot moves, so that the next frame differs. */
export function draw(context: CanvasRenderingContext2D, camera: Camera, scene: Scene): boolean {
  drawGround(context, camera, scene);
  return drawAbove(context, camera, scene);
}

/** Draws what robots drive on: all that does not move by itself. */
export function drawGround(context: CanvasRenderingContext2D, camera: Camera, scene: Scene): void {
  const palette = PALETTES[scene.theme];
  context.fillStyle = palette.ground;
  context.fillRect(0, 0, camera.width, camera.height);
  if (scene.showTerrains) drawTerrains(context, camera, scene);
  if (scene.friction) drawFriction(context, camera, scene.friction);
  drawGrid(context, camera, palette);
  if (scene.showTerrains) labelTerrains(context, camera, scene, palette);
  if (scene.inspected && scene.friction) drawInspected(context, camera, scene.inspected, scene.friction.cellM, palette);
  if (scene.showFence && scene.fence) drawFence(context, camera, scene.fence, palette);
  drawPaths(context, camera, scene, palette);
  // Below robots and drafts, which its ground is not to hide.
  drawScale(context, camera, palette);
}

/** Draws robots, and what is drawn above them; true while one of them moves. */
export function drawAbove(context: CanvasRenderingContext2D, camera: Camera, scene: Scene): boolean {
  const palette = PALETTES[scene.theme];
  const isMoving = drawRobots(context, camera, scene, palette);
  if (scene.draft) {
    drawDraft(context, camera, scene.draft, scene.faulty, palette);
    context.lineWidth = 2;
    context.strokeStyle = palette.planned;
    if (scene.dryRun) strokePlanned(context, camera, scene.dryRun, []);
  }
  if (scene.showCross) drawCross(context, camera, palette);
  return isMoving;
}

function trace(context: CanvasRenderingContext2D, camera: Camera, points: readonly PointM[]): void {
  context.beginPath();
  for (const point of points) {
    const { x, y } = camera.toPx(point);
    context.lineTo(x, y);
  }
}

function label(
  context: CanvasRenderingContext2D,
  text: string,
  x: number,
  y: number,
  colour: string,
  palette: Palette,
): void {
  context.lineWidth = 3;
  context.lineJoin = 'round';
  context.strokeStyle = palette.halo;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

function drawTerrains(context: CanvasRenderingContext2D, camera: Camera, scene: Scene): void {
  for (const terrain of [...scene.terrains].sort((a, b) => a.layer - b.layer)) {
    trace(context, camera, terrain.polygon);
    context.closePath();
    context.fillStyle = groundFill(terrain.class, scene.theme);
    context.fill();
    context.lineWidth = 1;
    context.strokeStyle = groundLine(terrain.class, scene.theme);
    context.stroke();
  }
}

/** Writes the names of terrains, above the friction measured there. */
function labelTerrains(context: CanvasRenderingContext2D, camera: Camera, scene: Scene, palette: Palette): void {
  context.font = '12px system-ui, sans-serif';
  context.textAlign = 'center';
  for (const terrain of scene.terrains) {
    const at = camera.toPx(labelPlace(terrain.polygon));
    const text = `${terrain.name} · ${texts.terrains.classes[terrain.class]}`;
    // From far names would only cover each other.
    if (context.measureText(text).width > widthM(terrain.polygon) * camera.scale) continue;
    label(context, text, at.x, at.y, palette.text, palette);
  }
}

/** From the leftmost to the rightmost corner, metres. */
function widthM(polygon: readonly PointM[]): number {
  let [least, most] = [Infinity, -Infinity];
  for (const { x_m } of polygon) {
    least = Math.min(least, x_m);
    most = Math.max(most, x_m);
  }
  return most - least;
}

/** Just inside the upper edge of a polygon, in its middle. */
function labelPlace(polygon: readonly PointM[]): PointM {
  let [xMin, xMax, yMax, yMin] = [Infinity, -Infinity, -Infinity, Infinity];
  for (const { x_m, y_m } of polygon) {
    xMin = Math.min(xMin, x_m);
    xMax = Math.max(xMax, x_m);
    yMax = Math.max(yMax, y_m);
    yMin = Math.min(yMin, y_m);
  }
  return { x_m: (xMin + xMax) / 2, y_m: yMax - (yMax - yMin) * 0.06 };
}

function drawGrid(context: CanvasRenderingContext2D, camera: Camera, palette: Palette): void {
  const step = stepM(GRID_PX / camera.scale);
  const { xMin, yMin, xMax, yMax } = camera.bounds;
  for (const isStrong of [false, true]) {
    context.beginPath();
    for (let index = Math.ceil(xMin / step); index * step <= xMax; index += 1) {
      if ((index % 5 === 0) !== isStrong) continue;
      const x = Math.round(camera.toPx({ x_m: index * step, y_m: 0 }).x) + 0.5;
      context.moveTo(x, 0);
      context.lineTo(x, camera.height);
    }
    for (let index = Math.ceil(yMin / step); index * step <= yMax; index += 1) {
      if ((index % 5 === 0) !== isStrong) continue;
      const y = Math.round(camera.toPx({ x_m: 0, y_m: index * step }).y) + 0.5;
      context.moveTo(0, y);
      context.lineTo(camera.width, y);
    }
    context.lineWidth = 1;
    context.globalAlpha = 0.7;
    context.strokeStyle = isStrong ? palette.gridStrong : palette.grid;
    context.stroke();
    context.globalAlpha = 1;
  }
}

function drawFence(context: CanvasRenderingContext2D, camera: Camera, fence: Geofence, palette: Palette): void {
  context.lineWidth = 2;
  for (const polygon of fence.keep_in) {
    trace(context, camera, polygon);
    context.closePath();
    context.setLineDash([10, 4]);
    context.strokeStyle = palette.fence;
    context.stroke();
  }
  for (const polygon of fence.keep_out) {
    trace(context, camera, polygon);
    context.closePath();
    context.setLineDash([3, 3]);
    context.strokeStyle = palette.fenceOut;
    context.stroke();
    context.globalAlpha = 0.12;
    context.fillStyle = palette.fenceOut;
    context.fill();
    context.globalAlpha = 1;
  }
  context.setLineDash([]);
}

/** Traces what was asked for: a circle exactly, waypoints joined by straight lines. */
export function traceTrajectory(context: CanvasRenderingContext2D, camera: Camera, asked: Trajectory): void {
  if ('circle' in asked) {
    const { center, radius_m } = asked.circle;
    const { x, y } = camera.toPx(center);
    context.beginPath();
    context.arc(x, y, radius_m * camera.scale, 0, 2 * Math.PI);
  } else {
    trace(context, camera, asked.waypoints.points);
  }
}

/** Strokes a planned path: its approach in short dashes, what was asked for in others or none. */
function strokePlanned(
  context: CanvasRenderingContext2D,
  camera: Camera,
  { points, approach }: Planned,
  dash: number[],
): void {
  if (approach > 0) {
    context.setLineDash(APPROACH_DASH);
    trace(context, camera, points.slice(0, approach + 1));
    context.stroke();
  }
  context.setLineDash(dash);
  trace(context, camera, points.slice(approach));
  context.stroke();
  context.setLineDash([]);
}

function drawPaths(context: CanvasRenderingContext2D, camera: Camera, scene: Scene, palette: Palette): void {
  for (const mission of scene.missions) {
    const isWaiting = mission.state === 'queued';
    if (isWaiting && mission.robot !== scene.selected) continue;
    context.globalAlpha = isWaiting ? 0.4 : mission.robot === scene.selected ? 1 : 0.6;
    context.lineWidth = mission.robot === scene.selected ? 2 : 1.25;
    context.strokeStyle = palette.planned;
    const path = scene.pathOf(mission);
    if (path) strokePlanned(context, camera, path, []);
    else {
      traceTrajectory(context, camera, mission.trajectory);
      context.stroke();
    }
    if ('waypoints' in mission.trajectory && !isWaiting && mission.trajectory.waypoints.points.length <= 200) {
      context.fillStyle = palette.planned;
      for (const point of mission.trajectory.waypoints.points) {
        const { x, y } = camera.toPx(point);
        context.fillRect(x - 2, y - 2, 4, 4);
      }
    }
  }
  context.globalAlpha = 1;
  if (scene.driven) {
    context.lineWidth = 2;
    context.strokeStyle = palette.planned;
    const { asked, planned, points, moment } = scene.driven;
    // Dashed, since what was driven lies on it.
    if (planned) strokePlanned(context, camera, planned, PLANNED_DASH);
    else {
      context.setLineDash(PLANNED_DASH);
      traceTrajectory(context, camera, asked);
      context.stroke();
    }
    context.setLineDash([]);
    context.lineWidth = 2.5;
    context.strokeStyle = palette.driven;
    if (moment) {
      // What came after the moment is faint.
      context.globalAlpha = 0.35;
      trace(context, camera, points);
      context.stroke();
      context.globalAlpha = 1;
      trace(context, camera, [...points.slice(0, moment.index + 1), moment.at]);
      context.stroke();
      drawMoment(context, camera, moment, palette);
    } else {
      trace(context, camera, points);
      context.stroke();
    }
  }
  context.setLineDash([]);
}

/** Where the robot was: an arrow, not to be taken for the robot itself. */
function drawMoment(context: CanvasRenderingContext2D, camera: Camera, moment: Moment, palette: Palette): void {
  const { x, y } = camera.toPx(moment.at);
  context.save();
  context.translate(x, y);
  context.rotate(-moment.course_rad);
  context.beginPath();
  context.moveTo(MOMENT_PX, 0);
  context.lineTo(-MOMENT_PX * 0.8, MOMENT_PX * 0.7);
  context.lineTo(-MOMENT_PX * 0.4, 0);
  context.lineTo(-MOMENT_PX * 0.8, -MOMENT_PX * 0.7);
  context.closePath();
  context.fillStyle = palette.halo;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = palette.driven;
  context.stroke();
  context.restore();
}

function drawDraft(
  context: CanvasRenderingContext2D,
  camera: Camera,
  draft: Draft,
  faulty: readonly number[],
  palette: Palette,
): void {
  context.strokeStyle = palette.draft;
  context.fillStyle = palette.draftFill;
  context.lineWidth = 2;
  if (draft.kind === 'circle') {
    if (!draft.center || draft.flaw) return;
    const { x, y } = camera.toPx(draft.center);
    context.beginPath();
    context.arc(x, y, draft.radius_m * camera.scale, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    context.beginPath();
    context.moveTo(x - 5, y);
    context.lineTo(x + 5, y);
    context.moveTo(x, y - 5);
    context.lineTo(x, y + 5);
    context.stroke();
    return;
  }
  trace(context, camera, draft.points);
  if (draft.kind === 'terrain') {
    context.closePath();
    context.fill();
  }
  context.stroke();
  context.font = '11px system-ui, sans-serif';
  context.textAlign = 'center';
  draft.points.forEach((point, index) => {
    const { x, y } = camera.toPx(point);
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    const isFaulty = faulty.includes(index + 1);
    context.fillStyle = isFaulty ? palette.stopped : palette.draft;
    context.fill();
    if (isFaulty) {
      context.beginPath();
      context.arc(x, y, FAULTY_PX, 0, 2 * Math.PI);
      context.lineWidth = 2.5;
      context.strokeStyle = palette.stopped;
      context.stroke();
    }
    label(context, String(index + 1), x, y - (isFaulty ? FAULTY_PX + 4 : 10), isFaulty ? palette.stopped : palette.draft, palette);
  });
}

function drawCross(context: CanvasRenderingContext2D, camera: Camera, palette: Palette): void {
  const x = Math.round(camera.width / 2) + 0.5;
  const y = Math.round(camera.height / 2) + 0.5;
  context.beginPath();
  context.moveTo(x - 12, y);
  context.lineTo(x + 12, y);
  context.moveTo(x, y - 12);
  context.lineTo(x, y + 12);
  context.lineWidth = 1;
  context.strokeStyle = palette.text;
  context.stroke();
}

function drawScale(context: CanvasRenderingContext2D, camera: Camera, palette: Palette): void {
  const { length_m, text } = scaleBar(SCALE_BAR_PX / camera.scale);
  const width = length_m * camera.scale;
  const [x, y] = [14, camera.height - 14];
  context.font = '12px system-ui, sans-serif';
  context.textAlign = 'center';
  // A ground of its own, so that it is read over every colour of the layers.
  const half = Math.max(width, context.measureText(text).width) / 2 + SCALE_BAR_MARGIN_PX;
  const top = y - 20 - SCALE_BAR_MARGIN_PX;
  context.fillStyle = palette.ground;
  context.globalAlpha = 0.9;
  context.fillRect(x + width / 2 - half, top, 2 * half, y + SCALE_BAR_MARGIN_PX - top);
  context.globalAlpha = 1;
  context.beginPath();
  context.moveTo(x, y - 6);
  context.lineTo(x, y);
  context.lineTo(x + width, y);
  context.lineTo(x + width, y - 6);
  context.lineWidth = 2;
  context.strokeStyle = palette.text;
  context.stroke();
  context.fillStyle = palette.text;
  context.fillText(text, x + width / 2, y - 8);
}
