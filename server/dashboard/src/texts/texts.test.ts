// The dictionaries against each other, and the components against texts of their own.
import { readFileSync, readdirSync } from 'node:fs';
import { parse } from 'svelte/compiler';
import { expect, test } from 'vitest';
import type { Session } from '../api/schema';
import { de } from './de';
import { en } from './en';
import { alertTitles } from './en_words';

/** What is the same word in both languages, by where it stands. */
const SAME = [
  'name',
  'signIn.token',
  'signIn.as',
  'settings.languages.en',
  'settings.languages.de',
  'settings.systems.imperial',
  'header.live',
  'stop.keys.one',
  'link.online',
  'link.offline',
  'robots.groups.lost',
  'robots.position',
  'curves.theta',
  'alerts.server',
  'webhooks.title',
  'webhooks.name',
  'drive.gamepad',
  'missions.detail',
  'draw.point',
  'draw.radius',
  'draw.head',
  'draw.robotIs',
  'draw.slowsBy',
  'replay.times',
  'fence.title',
  'terrains.label',
  'terrains.theta',
  'terrains.classes.asphalt',
  'terrains.classes.sand',
  'map.help.0.0',
  'map.help.7.0',
  'map.help.10.0',
  'map.fence',
  'map.theta',
  'map.stiffness',
  'map.unsureFrom',
  'map.tooMuch',
  'map.atLeast',
  'map.plusMinus',
  'unit.s',
  'unit.percent',
  'unit.ms',
  'unit.deg',
  'unit.h',
  'unit.d',
  'unit.min',
  'unit.radps',
  'unit.volt',
  'unknown',
];
/** What is a text of the server's own in English. */
const OF_SERVER = ['problem.title', 'missions.note', 'alerts.title', 'drive.released', 'drive.refused'];

const SESSION = { name: 'desk', role: 'operator', grants: [], rights: [], sites: null } as unknown as Session;
/** Arguments that functions of a dictionary are called with: numbers, one of something, names, switches. */
const SAMPLES: unknown[][] = [
  [3, 7, 5, 9],
  [1, 1, 1, 1],
  ['rover-1', 'North yard', 'pallet', 'x'],
  [true, true],
  [false, false],
];

/** Which of the samples are names. */
const NAMES = 2;

type Of = (...of: unknown[]) => unknown;

/** Everything that a dictionary says, by where it stands: texts, and what functions make of samples. */
function said(dictionary: unknown, path = ''): Map<string, string[]> {
  const found = new Map<string, string[]>();
  if (typeof dictionary === 'string') found.set(path, [dictionary]);
  else if (typeof dictionary === 'function') {
    const samples = path === 'rights' ? [[SESSION]] : OF_SERVER.includes(path) ? SAMPLES.slice(NAMES, NAMES + 1) : SAMPLES;
    found.set(path, samples.map((sample) => String((dictionary as Of)(...sample))));
  } else {
    for (const [key, value] of Object.entries(dictionary as Record<string, unknown>)) {
      for (const [at, texts] of said(value, path ? `${path}.${key}` : key)) found.set(at, texts);
    }
  }
  return found;
}

const english = said(en);
const german = said(de);

test('the dictionaries have the same keys', () => {
  expect([...german.keys()].sort()).toEqual([...english.keys()].sort());
  expect(english.size).toBeGreaterThan(400);
});

test('nothing is empty, and functions take as much', () => {
  for (const dictionary of [english, german]) {
    for (const [path, texts] of dictionary) {
      if (OF_SERVER.includes(path)) continue;
      for (const text of texts) expect(text.trim(), path).not.toBe('');
    }
  }
  const counts = (value: unknown): unknown =>
    typeof value === 'function'
      ? value.length
      : typeof value === 'string'
        ? 0
        : Object.fromEntries(Object.entries(value as object).map(([key, part]) => [key, counts(part)]));
  const [mine, other] = [counts(en) as Record<string, object>, counts(de) as Record<string, object>];
  // What the server's own text makes superfluous may be left out.
  for (const [area, parts] of Object.entries(mine)) {
    if (area !== 'drive' && area !== 'problem') expect(other[area], area).toEqual(parts);
  }
});

test('nothing is left in English but words that are the same in both', () => {
  const same = [...english].filter(([path, texts]) => german.get(path)?.some((text, index) => text.toLowerCase() === texts[index]?.toLowerCase()));
  expect(same.map(([path]) => path).filter((path) => !OF_SERVER.includes(path)).sort()).toEqual([...SAME].sort());
});

test('what a function is given is in what it says, in both languages', () => {
  for (const [path, texts] of english) {
    const [mine, other] = [texts[NAMES], german.get(path)?.[NAMES]];
    if (OF_SERVER.includes(path) || mine === undefined || other === undefined) continue;
    for (const name of SAMPLES[NAMES] ?? []) {
      if (String(name).length > 1) expect(other.includes(String(name)), `${path}: ${other}`).toBe(mine.includes(String(name)));
    }
  }
});

test('every alert of the documentation has a title of its own in each language', () => {
  const rest = readFileSync(new URL('../../../../docs/rest.md', import.meta.url), 'utf8');
  const section = rest.split('\n## Alerts\n')[1]?.split('\n## ')[0] ?? '';
  const rows = section.split('\n').filter((line) => line.startsWith('| `'));
  // Of the codes about dropped messages the table has two examples.
  const codes = rows
    .flatMap((row) => [...(row.split('|')[1] ?? '').matchAll(/`([^`]+)`/g)].map((found) => found[1] ?? ''))
    .filter((code) => code !== 'base-late' && code !== 'base-value');
  expect(codes.length).toBeGreaterThan(30);
  expect(Object.keys(alertTitles).sort()).toEqual([...codes].sort());
  for (const { alerts } of [en, de]) {
    const titles = codes.map((code) => alerts.title(code));
    expect(new Set(titles).size).toBe(codes.length);
    for (const title of titles) expect(codes).not.toContain(title);
    expect(alerts.title('base-late')).toBe(alerts.title('base-value'));
    // What a newer agent says is shown as it is.
    expect(alerts.title('tyre-flat')).toBe('tyre-flat');
  }
});

const SOURCES = new URL('../', import.meta.url);
/** Attributes that people read or hear. */
const READ = ['title', 'placeholder', 'alt', 'label', 'aria-label', 'aria-valuetext', 'aria-description'];
/** Two letters in a row are a word. */
const WORD = /\p{L}{2}/u;

/** Texts that a component has of its own. */
function literals(source: string): string[] {
  const found: string[] = [];
  const look = (node: unknown): void => {
    if (Array.isArray(node)) {
      for (const part of node) look(part);
      return;
    }
    if (typeof node !== 'object' || node === null) return;
    const { type, name, data, value } = node as { type?: string; name?: string; data?: string; value?: unknown };
    if (type === 'Text' && data && WORD.test(data)) found.push(data.trim());
    if (type === 'StyleDirective') return;
    if (type === 'Attribute') {
      if (name && READ.includes(name) && Array.isArray(value)) look(value);
      return;
    }
    for (const part of Object.values(node)) look(part);
  };
  look(parse(source, { modern: true }).fragment);
  return found;
}

test('components have no texts of their own', () => {
  expect(literals('<p title="A title">Two <b>{words}</b></p>')).toEqual(['A title', 'Two']);
  const files = ['App.svelte', ...readdirSync(new URL('parts/', SOURCES)).map((name) => `parts/${name}`)];
  expect(files.length).toBeGreaterThan(30);
  for (const file of files) expect(literals(readFileSync(new URL(file, SOURCES), 'utf8')), file).toEqual([]);
});
