// Draws robots with their trails and labels. Every robot in sight has its label: close together they are shorter or
// on another side. In a crowd, where labels would cover the map and each other, robots that are selected, pointed at or
// in trouble are named as ever, and the labels of all others are short and pale.
import type { Tracked } from '../state/tracked';
import { span } from '../format';
import { texts } from '../texts';
import type { Camera } from './camera';
import type { Scene } from './draw';
import { Kept } from './kept';
import { doing, hasFault } from '../standstill';
import { Labels, crowdOf, shortened, type Box, type Wanted } from './labels';
import type { Shown } from './motion';
import type { Palette } from './palette';

/** Smallest a robot is drawn, pixels of its length. */
const ROBOT_PX = 15;
/** Points of a trail that are nearer to each other than this are one, pixels. */
const TRAIL_STEP_PX = 2;
/** Points of all trails that are drawn; of large fleets each trail has its newest ones. */
const TRAILS_POINTS_MAX = 40_000;
const FONT = '600 12px system-ui, sans-serif';
/** From the top of a label to its baseline, pixels. */
const BASELINE_PX = 11;
/** Width of the halo around a label, pixels. */
const HALO_PX = 3;
/** The sign above a robot in trouble, beside its colour: a triangle of this height, pixels. */
const SIGN_PX = 15;
/** From a robot to its sign, pixels. */
const SIGN_GAP_PX = 3;
/** Widths of labels that are kept. */
const WIDTHS_MAX = 5_000;
/** Of more robots than these, trails and labels are drawn anew only so often. */
const ANEW_MAX = 50;
/** Time between two times that they are, milliseconds: robots lie over what their trails lack meanwhile. */
const LABELS_ANEW_MS = 100;
const TRAILS_ANEW_MS = 200;

/** Labels of robots from frame to frame. */
export class RobotLabels {
  readonly places = new Labels();
  /** Labels, and trails, as they were drawn last. */
  readonly written = new Kept(LABELS_ANEW_MS);
  readonly trails = new Kept(TRAILS_ANEW_MS);
  /** Robots that were in a crowd when labels were written last. */
  crowd: ReadonlySet<string> = new Set();
  #short = new Map<string, string>();
  #names = '';
  #widths = new Map<string, number>();
  /** The shorter form of each name. */
  shortOf(names: readonly string[]): ReadonlyMap<string, string> {
    const key = names.join('\n');
    if (key !== this.#names) {
      this.#names = key;
      this.#short = shortened(names);
    }
    return this.#short;
  }

  /** Width of a label, pixels; the context has its font. */
  widthOf(context: CanvasRenderingContext2D, text: string): number {
    const known = this.#widths.get(text);
    if (known !== undefined) return known;
    if (this.#widths.size >= WIDTHS_MAX) this.#widths.clear();
    const width = Math.ceil(context.measureText(text).width) + HALO_PX;
    this.#widths.set(text, width);
    return width;
  }
}

/** A robot in sight, as it is drawn. */
interface Seen {
  tracked: Tracked;
  shown: Shown;
  x: number;
  y: number;
  length: number;
  width: number;
  colour: string;
  /** It is in fault, moves though it is commanded to rest, or its stop is not confirmed. */
  isInTrouble: boolean;
  /** Whose label comes first where there is little room. */
  rank: number;
}

/** A robot, and where it is drawn; null as long as its place is unknown. */
interface Placed {
  tracked: Tracked;
  shown: Shown | null;
}

/** Draws all robots; true while one of them moves, so that the next frame differs. */
export function drawRobots(context: CanvasRenderingContext2D, camera: Camera, scene: Scene, palette: Palette): boolean {
  const all = [...scene.tracked].map((tracked): Placed => ({ tracked, shown: tracked.shownAt(scene.now) }));
  const { labels, now } = scene;
  const show = (kept: Kept, count: number, draw: (to: CanvasRenderingContext2D) => void): boolean => {
    if (count > ANEW_MAX) return kept.show(context, camera, now, draw);
    draw(context);
    return false;
  };
  // What a trail lacks meanwhile lies under its robot.
  const isTrailOld = scene.showTrails && show(labels.trails, all.length, (to) => drawTrails(to, camera, all, palette));
  const seen = all.flatMap((placed) => seenOf(camera, placed, scene, palette) ?? []);
  const base = context.getTransform();
  for (const robot of seen) drawRobot(context, base, robot, scene, palette);
  context.setTransform(base);
  for (const robot of seen) if (robot.isInTrouble) drawSign(context, robot, palette);
  const isLabelOld = show(labels.written, seen.length, (to) => drawLabels(to, camera, seen, all, scene, palette));
  // What was not drawn anew in this frame may have changed.
  return isTrailOld || isLabelOld || all.some(({ shown }) => shown?.isMoving);
}

function drawTrails(context: CanvasRenderingContext2D, camera: Camera, all: Placed[], palette: Palette): void {
  // Lines of one pixel are drawn several times as fast as wider ones.
  context.lineWidth = 1;
  context.lineJoin = 'bevel';
  context.strokeStyle = palette.trail;
  const { scale } = camera;
  const left = camera.width / 2 - camera.center.x_m * scale;
  const top = camera.height / 2 + camera.center.y_m * scale;
  const pointsMax = Math.floor(TRAILS_POINTS_MAX / Math.max(1, all.length));
  for (const { tracked, shown } of all) {
    const { trail } = tracked;
    context.beginPath();
    let [xLast, yLast] = [Infinity, Infinity];
    for (let index = Math.max(0, trail.length - 2 * pointsMax); index < trail.length; index += 2) {
      const x = left + (trail[index] ?? 0) * scale;
      const y = top - (trail[index + 1] ?? 0) * scale;
      const isLast = index + 2 >= trail.length;
      if (!isLast && Math.abs(x - xLast) + Math.abs(y - yLast) < TRAIL_STEP_PX) continue;
      context.lineTo(x, y);
      [xLast, yLast] = [x, y];
    }
    if (shown && trail.length > 0) context.lineTo(left + shown.pose.x_m * scale, top - shown.pose.y_m * scale);
    context.stroke();
  }
}

function seenOf(camera: Camera, { tracked, shown }: Placed, scene: Scene, palette: Palette): Seen | null {
  const { robot } = tracked;
  if (!shown) return null;
  const { x, y } = camera.toPx(shown.pose);
  const length = Math.max(ROBOT_PX, (robot.model.wheelbase_m + 2 * robot.model.wheel_radius_m) * camera.scale);
  const width = Math.max(ROBOT_PX * 0.8, robot.model.track_width_m * camera.scale);
  const isOut = x < -length || y < -length || x > camera.width + length || y > camera.height + length;
  if (isOut) return null;
  const isLost = robot.link === 'offline';
  const isStopped = robot.live?.safety.stop != null || scene.unconfirmed.has(robot.id);
  // Of one that is not heard nobody knows whether it still is so.
  const isFaulty = !isLost && hasFault(robot.live);
  const isInTrouble = scene.unconfirmed.has(robot.id) || isFaulty || (!isLost && doing(robot.live).isBad);
  const colour = isStopped
    ? palette.stopped
    : isFaulty
      ? palette.fault
      : isLost || shown.isFrozen
        ? palette.robotLost
        : robot.link === 'stale' || scene.isOld
          ? palette.robotLate
          : palette.robot;
  const isChosen = robot.id === scene.selected || robot.id === scene.pointed;
  const rank = isChosen ? 0 : scene.marked.has(robot.id) ? 1 : isInTrouble || isLost ? 2 : isStopped ? 3 : 4;
  return { tracked, shown, x, y, length, width, colour, isInTrouble, rank };
}

/** Ranks of robots that are named in a crowd too. */
const NAMED_RANK_MAX = 2;
/** Opacity of the labels of all others in a crowd. */
const PALE = 0.5;

function drawRobot(context: CanvasRenderingContext2D, base: DOMMatrix, seen: Seen, scene: Scene, palette: Palette): void {
  const { x, y, length, width, colour } = seen;
  const { robot } = seen.tracked;
  const { heading_rad } = seen.shown.pose;
  const isLost = robot.link === 'offline';
  const isUnconfirmed = scene.unconfirmed.has(robot.id);
  const isMarked = scene.marked.has(robot.id);
  // Set at once: to keep and restore everything takes as long as to draw.
  const { a: ratio, e: left, f: top } = base;
  const [cos, sin] = [ratio * Math.cos(heading_rad), ratio * Math.sin(heading_rad)];
  context.setTransform(cos, -sin, sin, cos, left + ratio * x, top + ratio * y);
  if (robot.id === scene.selected || isMarked || isUnconfirmed) {
    context.beginPath();
    context.arc(0, 0, ringPx(seen), 0, 2 * Math.PI);
    context.lineWidth = isUnconfirmed ? 4 : 2;
    context.strokeStyle = isUnconfirmed ? palette.stopped : palette.selected;
    context.stroke();
  }
  context.beginPath();
  if (isLost) {
    // Its last known place: an empty, dashed outline.
    context.roundRect(-length / 2, -width / 2, length, width, 3);
    context.setLineDash([3, 3]);
    context.fillStyle = palette.halo;
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = colour;
    context.stroke();
    context.setLineDash([]);
  } else {
    // As wide as with an outline, which would take as long again.
    context.roundRect(-length / 2 - 1, -width / 2 - 1, length + 2, width + 2, 4);
    context.fillStyle = colour;
    context.fill();
  }
  context.beginPath();
  context.moveTo(length * 0.36, 0);
  context.lineTo(-length * 0.12, width * 0.3);
  context.lineTo(-length * 0.12, -width * 0.3);
  context.closePath();
  context.fillStyle = isLost ? colour : palette.halo;
  context.fill();
}

/** Radius of the ring around a robot that is selected or has not confirmed its stop, pixels. */
function ringPx({ length, width }: Seen): number {
  return Math.hypot(length, width) / 2 + 5;
}

/** Where the sign above a robot lies. */
function signOf(seen: Seen): Box {
  const top = seen.y - ringPx(seen) - SIGN_GAP_PX - SIGN_PX;
  return { left: seen.x - SIGN_PX * 0.6, top, width: SIGN_PX * 1.2, height: SIGN_PX };
}

/** A triangle with an exclamation mark above a robot, which is recognised without its colour. */
function drawSign(context: CanvasRenderingContext2D, seen: Seen, palette: Palette): void {
  const { x } = seen;
  const { left, top, width, height } = signOf(seen);
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(left + width, top + height);
  context.lineTo(left, top + height);
  context.closePath();
  context.lineJoin = 'round';
  context.lineWidth = HALO_PX;
  context.strokeStyle = palette.halo;
  context.stroke();
  context.fillStyle = palette.fault;
  context.fill();
  context.fillStyle = palette.halo;
  context.fillRect(x - 1, top + SIGN_PX * 0.36, 2, SIGN_PX * 0.34);
  context.fillRect(x - 1, top + SIGN_PX * 0.78, 2, 2);
}

/** What may be written beside a robot, the longest first. */
function textsOf(
  { robot, ...tracked }: { robot: Tracked['robot']; age_s: number | null; trouble: string },
  short: string,
  isOld: boolean,
): string[] {
  const { name } = robot;
  const trouble = tracked.trouble && ` · ${tracked.trouble}`;
  const isLast = (robot.link === 'offline' || isOld) && tracked.age_s !== null;
  const note = isLast ? ` · ${texts.robots.lastKnown}, ${texts.robots.age(span(tracked.age_s))}` : '';
  const late = robot.link === 'stale' && !isOld ? ` · ${texts.link.stale}` : '';
  return [...new Set([`${name}${trouble}${late}${note}`, `${name}${trouble}`, name, short])];
}

function drawLabels(
  context: CanvasRenderingContext2D,
  camera: Camera,
  seen: Seen[],
  all: Placed[],
  scene: Scene,
  palette: Palette,
): void {
  const { labels } = scene;
  context.font = FONT;
  context.textAlign = 'left';
  context.lineWidth = HALO_PX;
  context.lineJoin = 'round';
  context.strokeStyle = palette.halo;
  const short = labels.shortOf(all.map(({ tracked }) => tracked.robot.name));
  const widthOf = (text: string) => labels.widthOf(context, text);
  const members = seen.map(({ tracked: { robot }, x, y, length, width }) => {
    return { id: robot.id, x, y, reach: Math.max(length, width) / 2, width: widthOf(robot.name) };
  });
  labels.crowd = crowdOf(members, labels.crowd);
  const isNamed = ({ rank, tracked }: Seen) => rank <= NAMED_RANK_MAX || !labels.crowd.has(tracked.robot.id);
  const order = [...seen].sort((a, b) => Number(isNamed(b)) - Number(isNamed(a)) || a.rank - b.rank);
  const wanted = order.map((one): Wanted => {
    const { tracked, x, y, length, width, isInTrouble } = one;
    const { robot } = tracked;
    const reach = Math.max(length, width) / 2;
    const shortName = short.get(robot.name) ?? robot.name;
    if (!isNamed(one)) return { id: robot.id, x, y, reach, texts: [shortName] };
    const age_s = tracked.ageS(scene.now);
    const trouble = scene.unconfirmed.has(robot.id)
      ? texts.stop.problems.unconfirmed
      : isInTrouble
        ? hasFault(robot.live)
          ? texts.mode.fault
          : doing(robot.live).text
        : '';
    return { id: robot.id, x, y, reach, texts: textsOf({ robot, age_s, trouble }, shortName, scene.isOld) };
  });
  const view = { left: 0, top: 0, width: camera.width, height: camera.height };
  const signs = seen.filter(({ isInTrouble }) => isInTrouble).map(signOf);
  const placed = labels.places.place(wanted, widthOf, view, signs);
  // Those that come first lie above.
  for (let index = placed.length - 1; index >= 0; index -= 1) {
    const label = placed[index];
    const robot = order[index];
    if (!label || !robot) continue;
    const [x, y] = [label.left + HALO_PX / 2, label.top + BASELINE_PX];
    context.globalAlpha = isNamed(robot) ? 1 : PALE;
    context.strokeText(label.text, x, y);
    context.fillStyle = robot.colour;
    context.fillText(label.text, x, y);
  }
  context.globalAlpha = 1;
}
