import { afterEach, expect, test, vi } from 'vitest';
import { FOOT_M, UNITS, about, amount, fromField, inField, measure, scaleBar, stepM, type Kind } from './units';
import { SYSTEMS, type System } from './locale';
import { preferences } from './preferences.svelte';

vi.stubGlobal('localStorage', { setItem: () => undefined });
afterEach(() => show('metric'));

const show = (system: System) => (preferences.system = system);
const KINDS = Object.keys(UNITS.metric) as Kind[];
/** Values of each property that are tried. */
const TRIES = 1_000;

/** The same numbers each time, 0 to 1 (mulberry32). */
function random(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let mixed = Math.imul(state ^ (state >>> 15), 1 | state);
    mixed = (mixed + Math.imul(mixed ^ (mixed >>> 7), 61 | mixed)) ^ mixed;
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 4_294_967_296;
  };
}

test('units are what they are defined to be', () => {
  expect([FOOT_M, UNITS.imperial.mass.si, UNITS.imperial.offset.si * 12]).toEqual([0.3048, 0.45359237, 0.3048]);
  show('imperial');
  expect(measure('length', 0.3048, 1)).toBe('1.0 ft');
  expect(measure('speed', 1, 2)).toBe('3.28 ft/s');
  expect(measure('offset', 0.0254, 0)).toBe('1.00 in');
  expect(measure('area', 1, 1)).toBe('10.8 ft²');
  expect(about('mass', 100)).toBe('220 lb');
  expect(about('force', 1_000)).toBe('225 lbf');
  expect(amount('length', null, 1)).toBe('–');
  expect(measure('length', undefined, 1)).toBe('–');
  show('metric');
  expect(measure('offset', 0.0123, 1)).toBe('12.3 mm');
  expect(measure('speed', 0.5, 2)).toBe('0.50 m/s');
});

test('what is shown and typed again is what it was', () => {
  const next = random(1);
  for (const system of SYSTEMS) {
    for (const kind of KINDS) {
      for (let index = 0; index < TRIES; index += 1) {
        const si = (next() - 0.5) * 10 ** Math.floor(next() * 8 - 3);
        const shown = inField(kind, si, system);
        expect(fromField(kind, shown, [si], system), `${si} as ${shown}`).toBe(si);
      }
    }
  }
});

test('what is typed is sent exactly, is shown as typed, and does not drift however often', () => {
  const next = random(2);
  for (const system of SYSTEMS) {
    for (const kind of ['length', 'speed'] as const) {
      for (let index = 0; index < TRIES; index += 1) {
        // As people type: a few digits.
        const typed = 0 + Number(((next() - 0.5) * 10 ** Math.floor(next() * 5)).toFixed(Math.floor(next() * 5)));
        let si = fromField(kind, typed, [], system);
        const sent = si;
        expect(Math.abs(si - typed * UNITS[system][kind].si)).toBeLessThan(1e-9);
        for (let again = 0; again < 5; again += 1) {
          expect(inField(kind, si, system)).toBe(typed);
          // As if nobody knew what it was.
          si = fromField(kind, inField(kind, si, system), [], system);
        }
        expect(si).toBe(sent);
      }
    }
  }
});

test('the bound that a field shows can be typed', () => {
  const next = random(3);
  for (let index = 0; index < TRIES; index += 1) {
    const top = next() * 5;
    expect(fromField('speed', inField('speed', top, 'imperial'), [0.5, 0.05, top], 'imperial')).toBe(top);
  }
});

test('an empty field is no number, and no number is an empty field', () => {
  expect([fromField('length', null), fromField('length', NaN)]).toEqual([NaN, NaN]);
  expect([inField('length', NaN), inField('length', null), inField('length', undefined)]).toEqual([null, null, null]);
});

test('scale bars and lines are round in the unit that is shown', () => {
  expect([0.003, 0.04, 0.7, 1.2, 30].map((least) => scaleBar(least).text)).toEqual(['5 mm', '5 cm', '1 m', '2 m', '50 m']);
  expect(stepM(0.7)).toBe(1);
  show('imperial');
  expect([0.003, 0.04, 0.7, 1.2, 30].map((least) => scaleBar(least).text)).toEqual(['0.2 in', '2 in', '5 ft', '5 ft', '100 ft']);
  expect(stepM(0.7)).toBeCloseTo(5 * FOOT_M, 12);
  const next = random(4);
  for (const system of SYSTEMS) {
    show(system);
    for (let index = 0; index < TRIES; index += 1) {
      const least = 10 ** (next() * 7 - 3);
      const bar = scaleBar(least);
      expect(bar.length_m, bar.text).toBeGreaterThanOrEqual(least * (1 - 1e-6));
      expect(bar.length_m, bar.text).toBeLessThanOrEqual(least * 2.6);
    }
  }
});
