// What the address of the page keeps: what is shown, selected and drawn, so that a reload or a link brings
// it back. Pure. Whatever in an address is not understood is left out.
import type { TerrainClass } from './api/schema';
import type { PointM } from './map/camera';
import type { DraftKind } from './map/draft';
import { RANGES, type Quantity } from './map/friction';
import { SPANS, type Span } from './map/moments';
import { texts } from './texts';

export const TABS = ['robots', 'missions', 'alerts', 'terrains'] as const;
export const HIDEABLE = ['terrains', 'fence', 'trails'] as const;
export type Hideable = (typeof HIDEABLE)[number];
const WHATS = ['mission', 'replace', 'terrain', 'keep_in', 'keep_out'] as const;
const KINDS = ['circle', 'waypoints', 'terrain'] as const satisfies readonly DraftKind[];
const STARTS = ['append', 'replace', 'refuse'] as const;
const LINKS = ['continue', 'stop_after'] as const;
/** The friction layer shows the change between two times. */
export const CHANGE = 'change';
/** What the friction layer shows from the start. */
export const LAYER_FIRST = 'theta' satisfies Quantity;
const LAYERS: readonly string[] = [...Object.keys(RANGES), CHANGE];
const LAYER_NONE = 'none';
const CLASSES = Object.keys(texts.terrains.classes) as TerrainClass[];

/** Longest address that browsers and chats take well; a longer draft is kept by the tab alone. */
export const ADDRESS_MAX = 6_000;

/** What is being drawn, and for what. */
export interface DraftState {
  what: (typeof WHATS)[number];
  /** The mission or terrain that it changes; empty for a new one. */
  of: string;
  kind: DraftKind;
  center: PointM | null;
  radius_m: number;
  points: PointM[];
  /** The area of the geofence that it changes. */
  old: PointM[] | null;
  /** The revision of the terrain that it changes; null for none. */
  revision: number | null;
  robot: string;
  robots: string[];
  speed_m_s: number;
  turns: number;
  clockwise: boolean;
  excite: boolean;
  priority: number;
  start: (typeof STARTS)[number];
  link: (typeof LINKS)[number];
  id: string;
  name: string;
  class: TerrainClass;
  layer: number;
}

export interface Place {
  site: string | null;
  tab: (typeof TABS)[number];
  robot: string | null;
  marked: string[];
  view: { center: PointM; scale: number } | null;
  /** What the friction layer shows, or `CHANGE`; empty for none. */
  layer: string;
  /** The time that the friction layer is shown of, with the span of its slider; null for the present. */
  time: { at_ms: number; span: Span } | null;
  /** The times that the friction layer compares; the second is null for the present. */
  compared: { from_ms: number; to_ms: number | null } | null;
  hidden: Hideable[];
  /** The alert that is shown; null for none. */
  alert: string | null;
  draft: DraftState | null;
}

/** Digits of numbers in metres: of what is seen, and of what is drawn, which another unit may need. */
const SEEN_DIGITS = 3;
const DRAWN_DIGITS = 9;

const number = (value: number, digits = DRAWN_DIGITS) =>
  Number.isFinite(value) ? String(Number(value.toFixed(digits))) : '';
const writePoints = (points: readonly PointM[]) => points.map(({ x_m, y_m }) => `${number(x_m)},${number(y_m)}`).join(';');

/** A moment, to the minute: `2026-01-31T14:05Z`. */
const writeMoment = (at_ms: number) => `${new Date(at_ms).toISOString().slice(0, 16)}Z`;

function readMoment(text: string | null): number | null {
  if (text === null || !/^\d{4}-\d{2}-\d{2}T\d{2}:\d{2}Z$/.test(text)) return null;
  const at_ms = Date.parse(text);
  return Number.isNaN(at_ms) ? null : at_ms;
}

/** What was typed and is no number is kept as none. */
const readNumber = (text: string | undefined) => (text === undefined || text.trim() === '' ? NaN : Number(text));

function readPoints(text: string): PointM[] {
  if (text === '') return [];
  return text.split(';').map((pair) => {
    const [x, y] = pair.split(',');
    return { x_m: readNumber(x), y_m: readNumber(y) };
  });
}

/** An address after its `#`, without the draft if that makes it too long. */
export function addressOf(place: Place, most = ADDRESS_MAX): string {
  const query = new URLSearchParams();
  if (place.site) query.set('site', place.site);
  if (place.tab !== 'robots') query.set('tab', place.tab);
  if (place.robot) query.set('robot', place.robot);
  if (place.marked.length > 0) query.set('selected', place.marked.join(','));
  if (place.view) {
    const { center, scale } = place.view;
    query.set('view', [center.x_m, center.y_m, scale].map((value) => number(value, SEEN_DIGITS)).join(','));
  }
  query.set('layer', place.layer || LAYER_NONE);
  if (place.time) {
    query.set('time', writeMoment(place.time.at_ms));
    query.set('span', place.time.span);
  }
  if (place.compared) {
    query.set('from', writeMoment(place.compared.from_ms));
    if (place.compared.to_ms !== null) query.set('to', writeMoment(place.compared.to_ms));
  }
  if (place.hidden.length > 0) query.set('hidden', place.hidden.join(','));
  if (place.alert) query.set('alert', place.alert);
  const plain = readable(query);
  if (!place.draft) return plain;
  const { center, points, old, radius_m, speed_m_s, turns, priority, layer } = place.draft;
  query.set(
    'draft',
    JSON.stringify({
      ...place.draft,
      center: center && writePoints([center]),
      points: writePoints(points),
      old: old && writePoints(old),
      radius_m: number(radius_m),
      speed_m_s: number(speed_m_s),
      turns: number(turns),
      priority: number(priority),
      layer: number(layer),
    }),
  );
  const whole = readable(query);
  return whole.length <= most ? whole : plain;
}

/** Characters that need no escape behind a `#` stay as they are. */
function readable(query: URLSearchParams): string {
  return query.toString().replaceAll('%2C', ',').replaceAll('%3B', ';').replaceAll('%3A', ':');
}

export function placeOf(address: string): Place {
  const query = new URLSearchParams(address.replace(/^#/, ''));
  const list = (name: string) => (query.get(name) ?? '').split(',').filter(Boolean);
  const [x_m = NaN, y_m = NaN, scale = NaN] = (query.get('view') ?? '').split(',').map(readNumber);
  const isView = [x_m, y_m, scale].every(Number.isFinite) && scale > 0;
  const [at_ms, from_ms] = [readMoment(query.get('time')), readMoment(query.get('from'))];
  return {
    site: query.get('site'),
    tab: oneOf(TABS, query.get('tab')) ?? 'robots',
    robot: query.get('robot'),
    marked: list('selected'),
    view: isView ? { center: { x_m, y_m }, scale } : null,
    layer: layerOf(query.get('layer')),
    time: at_ms === null ? null : { at_ms, span: oneOf(SPANS, query.get('span')) ?? 'day' },
    compared: from_ms === null ? null : { from_ms, to_ms: readMoment(query.get('to')) },
    hidden: list('hidden').flatMap((name) => oneOf(HIDEABLE, name) ?? []),
    alert: query.get('alert'),
    draft: draftOf(query.get('draft')),
  };
}

/** What the tab kept when its page went: everything as it was, and the address that it had until then. */
export interface KeptByTab {
  place: string;
  address: string | null;
  /** Whether the page was loaded by a reload. */
  isReload: boolean;
}

/**
 * What a page that starts brings back. An address from elsewhere counts. The tab's own gives way to what the tab kept,
 * which is newer and has drafts that are too long for an address: browsers reload the address that a page had when
 * the reload began, and the page goes on until the server has answered.
 */
export function placeAtStart(hash: string, tab: KeptByTab): Place {
  const kept = placeOf(tab.place);
  const isOwn = tab.address !== null && (tab.isReload || hash === tab.address);
  if (!hash.includes('=') || (isOwn && kept.site)) return kept;
  const place = placeOf(hash);
  const bare = (place: Place) => addressOf({ ...place, draft: null });
  if (!place.draft && bare(kept) === bare(place)) place.draft = kept.draft;
  return place;
}

/** An address that says nothing of the layer shows the one that is shown from the start. */
function layerOf(text: string | null): string {
  if (text === LAYER_NONE) return '';
  return oneOf(LAYERS, text) ?? LAYER_FIRST;
}

function oneOf<T extends string>(names: readonly T[], name: unknown): T | null {
  return names.find((known) => known === name) ?? null;
}

function draftOf(text: string | null): DraftState | null {
  if (text === null) return null;
  let read: unknown;
  try {
    read = JSON.parse(text);
  } catch {
    return null;
  }
  if (typeof read !== 'object' || read === null) return null;
  const of = (name: string): unknown => (read as Record<string, unknown>)[name];
  const word = (name: string) => (typeof of(name) === 'string' ? (of(name) as string) : '');
  const what = oneOf(WHATS, of('what'));
  const kind = oneOf(KINDS, of('kind'));
  if (!what || !kind) return null;
  const robots = of('robots');
  return {
    what,
    of: word('of'),
    kind,
    center: readPoints(word('center'))[0] ?? null,
    radius_m: readNumber(word('radius_m')),
    points: readPoints(word('points')),
    old: typeof of('old') === 'string' ? readPoints(word('old')) : null,
    revision: Number.isInteger(of('revision')) ? (of('revision') as number) : null,
    robot: word('robot'),
    robots: Array.isArray(robots) ? robots.filter((id): id is string => typeof id === 'string') : [],
    speed_m_s: readNumber(word('speed_m_s')),
    turns: readNumber(word('turns')),
    clockwise: of('clockwise') === true,
    excite: of('excite') === true,
    priority: readNumber(word('priority')),
    start: oneOf(STARTS, of('start')) ?? 'append',
    link: oneOf(LINKS, of('link')) ?? 'continue',
    id: word('id'),
    name: word('name'),
    class: oneOf(CLASSES, of('class')) ?? 'grass',
    layer: readNumber(word('layer')),
  };
}
