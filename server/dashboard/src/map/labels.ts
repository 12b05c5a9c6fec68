// Where the labels of robots stand: every one somewhere, beside each other as far as there is room; and which robots
// stand so close together that their labels would cover the map and each other. Pure.

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** A label that is wanted beside something. */
export interface Wanted {
  id: string;
  /** Middle of what it belongs to, and how far that reaches, pixels. */
  x: number;
  y: number;
  reach: number;
  /** What may be written, the longest first. There is at least one. */
  texts: readonly string[];
}

export interface Placed extends Box {
  id: string;
  text: string;
  /** It had to be put over another one. */
  isOver: boolean;
}

/** Height of a label, pixels. */
export const LABEL_PX = 14;
/** Room between a label and what it belongs to, pixels. */
const GAP_PX = 2;
const EVERYWHERE: Box = { left: -Infinity, top: -Infinity, width: Infinity, height: Infinity };
/** Side of the squares by which boxes are found, pixels. */
const SQUARE_PX = 48;

/** Where a label stands around its robot: its middle in units of the free distance. */
const PLACES: readonly (readonly [number, number])[] = [
  [1, -0.5],
  [1, 0.5],
  [-1, -0.5],
  [-1, 0.5],
  [1, 0],
  [-1, 0],
  [0, -1],
  [0, 1],
];

/** Boxes that are taken, found by where they are. */
class Taken {
  readonly #squares = new Map<number, Box[]>();

  add(box: Box): void {
    this.#each(box, (key) => {
      const square = this.#squares.get(key);
      if (square) square.push(box);
      else this.#squares.set(key, [box]);
      return false;
    });
  }

  meets(box: Box, except?: Box): boolean {
    return this.#each(box, (key) => {
      for (const other of this.#squares.get(key) ?? []) if (other !== except && overlap(other, box)) return true;
      return false;
    });
  }

  #each({ left, top, width, height }: Box, look: (key: number) => boolean): boolean {
    const right = Math.floor((left + width) / SQUARE_PX);
    const bottom = Math.floor((top + height) / SQUARE_PX);
    for (let ix = Math.floor(left / SQUARE_PX); ix <= right; ix += 1) {
      for (let iy = Math.floor(top / SQUARE_PX); iy <= bottom; iy += 1) {
        if (look(ix * 65_536 + iy)) return true;
      }
    }
    return false;
  }
}

export function overlap(a: Box, b: Box): boolean {
  return a.left < b.left + b.width && b.left < a.left + a.width && a.top < b.top + b.height && b.top < a.top + a.height;
}

function isWithin(box: Box, view: Box): boolean {
  if (view === EVERYWHERE) return true;
  const isAcross = box.left >= view.left && box.left + box.width <= view.left + view.width;
  return isAcross && box.top >= view.top && box.top + box.height <= view.top + view.height;
}

/** The box, moved into the view. */
function within(box: Box, view: Box): Box {
  if (view === EVERYWHERE) return box;
  const left = Math.max(view.left, Math.min(box.left, view.left + view.width - box.width));
  const top = Math.max(view.top, Math.min(box.top, view.top + view.height - box.height));
  return { ...box, left, top };
}

/** A robot with the width of its whole name. */
export interface Member {
  id: string;
  x: number;
  y: number;
  reach: number;
  /** Width of its name, pixels. */
  width: number;
}

/** Of fewer robots than these each has its label, however close together they are. */
export const CROWD_MIN = 20;
/** With so many others around its label a robot is in a crowd, and with so many it stays in one: it does not flicker. */
const CROWDED_BY = 6;
const STAYS_CROWDED_BY = 5;

/**
 * Robots in crowds: those with many others as near as a label reaches, and the robots beside these. `before` has those
 * that were in a crowd last.
 */
export function crowdOf(members: readonly Member[], before: ReadonlySet<string>): Set<string> {
  const crowd = new Set<string>();
  if (members.length < CROWD_MIN) return crowd;
  const sorted = [...members].sort((a, b) => a.x - b.x);
  const half = sorted.map(({ reach, width }) => ({ x: (reach + width) / 2 + GAP_PX, y: reach + LABEL_PX }));
  const widest = Math.max(...half.map(({ x }) => x));
  const near = sorted.map((): number[] => []);
  for (const [index, one] of sorted.entries()) {
    const mine = half[index];
    for (let next = index + 1; mine && next < sorted.length; next += 1) {
      const [other, theirs] = [sorted[next], half[next]];
      if (!other || !theirs || other.x - one.x > mine.x + widest) break;
      if (other.x - one.x >= mine.x + theirs.x || Math.abs(other.y - one.y) >= mine.y + theirs.y) continue;
      near[index]?.push(next);
      near[next]?.push(index);
    }
  }
  for (const [index, others] of near.entries()) {
    const id = sorted[index]?.id ?? '';
    if (others.length < (before.has(id) ? STAYS_CROWDED_BY : CROWDED_BY)) continue;
    for (const member of [index, ...others]) crowd.add(sorted[member]?.id ?? '');
  }
  return crowd;
}

/** Places labels frame after frame; one that still has its room stays where it was. */
export class Labels {
  /** Place and text that a label had last, as one number. */
  #last = new Map<string, number>();

  /**
   * Places all labels within `view`, the first of them first. Every label gets a place, and keeps off `signs` as it
   * does off robots.
   */
  place(
    wanted: readonly Wanted[],
    widthOf: (text: string) => number,
    view: Box = EVERYWHERE,
    signs: readonly Box[] = [],
  ): Placed[] {
    const marks = new Taken();
    const labels = new Taken();
    const own = wanted.map(({ x, y, reach }) => ({ left: x - reach, top: y - reach, width: 2 * reach, height: 2 * reach }));
    for (const mark of [...own, ...signs]) marks.add(mark);
    const last = new Map<string, number>();
    const placed = wanted.map((one, index): Placed => {
      const count = one.texts.length * PLACES.length;
      const isFree = (choice: number) => {
        const box = boxOf(one, choice, widthOf);
        return !isWithin(box, view) || labels.meets(box) || marks.meets(box, own[index]) ? null : box;
      };
      let choice = this.#last.get(one.id) ?? 0;
      if (choice >= count) choice = 0;
      // A longer text comes back as soon as there is room for it.
      const begin = choice - (choice % PLACES.length);
      let box: Box | null = null;
      for (let tried = 0; tried < begin && !box; tried += 1) {
        box = isFree(tried);
        if (box) choice = tried;
      }
      box ??= isFree(choice);
      for (let tried = begin; tried < count && !box; tried += 1) {
        box = isFree(tried);
        if (box) choice = tried;
      }
      const shortest = count - PLACES.length;
      for (let tried = shortest; tried < count && !box; tried += 1) {
        // Rather over another robot than over a label.
        const over = within(boxOf(one, tried, widthOf), view);
        if (labels.meets(over)) continue;
        box = over;
        choice = tried;
      }
      const isOver = box === null;
      if (!box) {
        choice = shortest;
        box = within(boxOf(one, choice, widthOf), view);
      }
      labels.add(box);
      last.set(one.id, choice);
      return { ...box, id: one.id, text: textOf(one, choice), isOver };
    });
    this.#last = last;
    return placed;
  }
}

function textOf({ texts }: Wanted, choice: number): string {
  return texts[Math.floor(choice / PLACES.length)] ?? '';
}

function boxOf(one: Wanted, choice: number, widthOf: (text: string) => number): Box {
  const [across, down] = PLACES[choice % PLACES.length] ?? [1, 0];
  const width = widthOf(textOf(one, choice));
  const free = one.reach + GAP_PX;
  // In whole pixels, so that a label does not tremble with its robot.
  const left = Math.round(one.x + across * (free + width / 2) - width / 2);
  const top = Math.round(one.y + (across === 0 ? down * (free + LABEL_PX / 2) : down * LABEL_PX) - LABEL_PX / 2);
  return { left, top, width, height: LABEL_PX };
}

/** Characters of a short label where names have nothing in common. */
const TAIL = 4;

/** Shorter forms of names: without what all of them begin with, else their ends. */
export function shortened(names: readonly string[]): Map<string, string> {
  let common = names[0] ?? '';
  for (const name of names) while (!name.startsWith(common)) common = common.slice(0, -1);
  // Not in the middle of a number, and not the whole of a name.
  common = common.replace(/\d+$/, '');
  const isEnough = common.length > 0 && names.every((name) => name.length > common.length);
  return new Map(
    names.map((name) => {
      if (names.length > 1 && isEnough) return [name, name.slice(common.length)];
      return [name, name.length > TAIL + 2 ? `…${name.slice(-TAIL)}` : name];
    }),
  );
}
