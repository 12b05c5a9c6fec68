import { expect, test } from 'vitest';
import { ADDRESS_MAX, CHANGE, LAYER_FIRST, addressOf, placeAtStart, placeOf, type DraftState, type Place } from './address';

const draft: DraftState = {
  what: 'mission',
  of: '',
  kind: 'waypoints',
  center: { x_m: 1.25, y_m: -3 },
  radius_m: 2,
  points: [
    { x_m: 1, y_m: 2.5 },
    { x_m: -4.25, y_m: NaN },
  ],
  old: null,
  revision: 7,
  robot: 'rover-1',
  robots: ['rover-1', 'rover-2'],
  speed_m_s: 0.5,
  turns: NaN,
  clockwise: true,
  excite: false,
  priority: 3,
  start: 'replace',
  link: 'stop_after',
  id: '',
  name: 'Æ & # %',
  class: 'sand',
  layer: 0,
};
const place: Place = {
  site: 'yard',
  tab: 'missions',
  robot: 'rover-2',
  marked: ['rover-1', 'rover-3'],
  view: { center: { x_m: 12.5, y_m: -0.25 }, scale: 33.3 },
  layer: 'theta',
  time: { at_ms: Date.UTC(2026, 0, 31, 14, 5), span: 'week' },
  compared: null,
  hidden: ['trails'],
  alert: null,
  draft,
};

test('what is shown, selected and drawn comes back from the address as it was', () => {
  const address = addressOf(place);
  expect(placeOf(`#${address}`)).toEqual(place);
  expect(address).toContain('view=12.5,-0.25,33.3');
  const bare = { ...place, draft: null, robot: null, marked: [], view: null, layer: '', time: null, hidden: [], tab: 'robots' } as const;
  const none = { ...bare, marked: [], hidden: [] };
  expect(addressOf(none)).toBe('site=yard&layer=none');
  expect(placeOf('#site=yard&layer=none')).toEqual(none);
  for (const layer of ['stiffness', CHANGE]) expect(placeOf(addressOf({ ...place, layer })).layer).toBe(layer);
});

test('an alert, the time of the friction layer and the times that it compares are in the address', () => {
  const alert = '0192f0c1-2b3c-7d4e-8f50-617283940a1c';
  expect(placeOf(`#site=yard&tab=alerts&alert=${alert}`)).toMatchObject({ site: 'yard', tab: 'alerts', alert });
  expect(addressOf(place)).toContain('time=2026-01-31T14:05Z&span=week');
  const compared = { from_ms: Date.UTC(2026, 0, 1, 8), to_ms: Date.UTC(2026, 0, 2, 9, 30) };
  const whole: Place = { ...place, tab: 'alerts', alert, layer: CHANGE, time: null, compared };
  expect(addressOf(whole)).toContain('from=2026-01-01T08:00Z&to=2026-01-02T09:30Z');
  expect(placeOf(addressOf(whole))).toEqual(whole);
  const open: Place = { ...whole, compared: { ...compared, to_ms: null } };
  expect(placeOf(addressOf(open))).toEqual(open);
  for (const wrong of ['now', '2026-13-01T00:00Z', '2026-01-01', '1e9']) {
    expect(placeOf(`site=yard&time=${wrong}&from=${wrong}`)).toMatchObject({ time: null, compared: null });
  }
  expect(placeOf('site=yard&time=2026-01-31T14:05Z&span=year').time?.span).toBe('day');
});

test('a reload brings back what the tab kept, an address from elsewhere what it says', () => {
  const bare = { ...place, draft: null, robot: null };
  const [own, other] = [`#${addressOf(bare)}`, '#site=yard&robot=rover-7'];
  const tab = { place: addressOf(place, Infinity), address: own, isReload: false };
  // The address was read before the last change was in it.
  expect(placeAtStart(own, tab)).toEqual(place);
  expect(placeAtStart('', tab)).toEqual(place);
  expect(placeAtStart(other, tab)).toEqual(placeOf(other));
  expect(placeAtStart(own, { place: '', address: null, isReload: true })).toEqual(bare);
  expect(placeAtStart(own, { place: '', address: own, isReload: true })).toEqual(bare);
  // The address changed after the reload had begun.
  const newer = { ...tab, address: `#${addressOf(place)}`, isReload: true };
  expect(placeAtStart(own, newer)).toEqual(place);
  expect(placeAtStart(own, { ...newer, isReload: false })).toEqual(bare);
  // The page that went had not brought its address back yet, or crashed.
  expect(placeAtStart(own, { ...newer, address: null })).toEqual(bare);
  // A draft that is too long for the address.
  const long = { ...place, draft };
  const short = `#${addressOf(long, 1)}`;
  expect(placeAtStart(short, { place: addressOf(long, Infinity), address: other, isReload: false })).toEqual(long);
});

test('an address that says nothing of the friction layer shows it', () => {
  for (const address of ['#site=yard&robot=rover-1', '#site=yard&layer=', '#site=yard&layer=snow', '']) {
    expect(placeOf(address).layer, address).toBe(LAYER_FIRST);
  }
});

test('what is not understood is left out, and breaks nothing', () => {
  const empty = placeOf('');
  for (const wrong of [
    '#signed-in',
    '#view=1,2',
    '#view=1,2,-3',
    '#view=a,b,c',
    '#tab=kitchen&hidden=walls',
    '#draft={',
    '#draft=7',
    '#draft={"what":"party","kind":"circle"}',
    '#draft={"what":"mission","kind":"spiral"}',
  ]) {
    expect(placeOf(wrong), wrong).toEqual(empty);
  }
  const odd = placeOf('#draft={"what":"mission","kind":"circle","robots":[1,"a"],"points":7,"class":"lava"}').draft;
  expect([odd?.robots, odd?.points, odd?.class, odd?.center]).toEqual([['a'], [], 'grass', null]);
});

test('a draft that makes the address too long is left out of it, and nothing else is', () => {
  const points = Array.from({ length: 2_000 }, (_, index) => ({ x_m: index, y_m: 1 - index }));
  const address = addressOf({ ...place, draft: { ...draft, points } });
  expect(address.length).toBeLessThan(ADDRESS_MAX);
  expect(placeOf(address)).toEqual({ ...place, draft: null });
  expect(placeOf(addressOf({ ...place, draft: { ...draft, points } }, Infinity)).draft?.points).toEqual(points);
});
