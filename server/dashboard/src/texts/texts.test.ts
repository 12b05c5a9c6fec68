// The dictionaries against each other, and the components against texts of their own.
import { readFileSync, readdirSync } from 'node:fs';
import { parse } from 'svelte/compiler';
import ts from 'typescript';
import { expect, test } from 'vitest';
import type { ProblemType, Session } from '../api/schema';
import { de } from './de';
import { problemTitles } from './de_words';
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
const OF_SERVER = [
  'problem.title',
  'missions.note',
  'alerts.title',
  'alerts.sentence',
  'alerts.notice',
  'drive.released',
  'drive.refused',
];

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

/** Codes of alerts in the documentation; of those about dropped messages it has two examples, which are left out. */
function alertCodes(): string[] {
  const rest = readFileSync(new URL('../../../../docs/rest.md', import.meta.url), 'utf8');
  const section = rest.split('\n## Alerts\n')[1]?.split('\n## ')[0] ?? '';
  const rows = section.split('\n').filter((line) => line.startsWith('| `'));
  return rows
    .flatMap((row) => [...(row.split('|')[1] ?? '').matchAll(/`([^`]+)`/g)].map((found) => found[1] ?? ''))
    .filter((code) => code !== 'base-late' && code !== 'base-value');
}

test('every alert of the documentation has a title of its own in each language', () => {
  const codes = alertCodes();
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

test('every alert of the documentation is a sentence of its own in each language, about its robot', () => {
  const codes = alertCodes();
  for (const { alerts } of [en, de]) {
    const sentences = codes.map((code) => alerts.sentence(code, 'rover-1'));
    expect(new Set(sentences).size).toBe(codes.length);
    for (const [index, sentence] of sentences.entries()) {
      expect(sentence).toMatch(/^\p{Lu}.+\.$|^rover-1 .+\.$/u);
      const isOfServer = /server|storage|database|disk|backup|archive|certificate-expiring|robots-await/.test(codes[index] ?? '');
      expect(sentence.includes('rover-1'), codes[index]).toBe(!isOfServer);
    }
    // Whatever the reason for which messages are dropped, and what a newer agent says.
    expect(alerts.sentence('base-late', 'rover-1')).toBe(alerts.sentence('base-value', 'rover-1'));
    expect(alerts.sentence('tyre-flat', 'rover-1')).toMatch(/rover-1.*tyre-flat/);
  }
  // A notification marks no language: there is no English in a German one.
  expect(de.alerts.notice('Der Akku ist leer.', 'battery at 2 %')).toBe('Der Akku ist leer.');
  expect(en.alerts.notice('The battery is empty.', 'battery at 2 %')).toContain('battery at 2 %');
});

test('every type of problem of the API has a sentence in each language', () => {
  const api = JSON.parse(readFileSync(new URL('../../../openapi.json', import.meta.url), 'utf8')) as {
    components: { schemas: { ProblemType: { enum: ProblemType[] } } };
  };
  const types = api.components.schemas.ProblemType.enum;
  expect(types.length).toBeGreaterThan(40);
  expect(Object.keys(problemTitles).sort()).toEqual([...types].sort());
  for (const type of types) {
    const german = de.problem.title(type, 'what the server says');
    expect(german, type).toMatch(/^\p{Lu}.*\p{L}$/u);
    expect(german).not.toContain('what the server says');
    // The server's own title is the English one.
    expect(en.problem.title(type, 'what the server says')).toBe('what the server says');
  }
  expect(new Set(Object.values(problemTitles)).size).toBe(types.length);
});

const SOURCES = new URL('../', import.meta.url);
/** Attributes that people read or hear. */
const READ = ['title', 'placeholder', 'alt', 'label', 'aria-label', 'aria-valuetext', 'aria-description'];
/** Two letters in a row are a word. */
const WORD = /\p{L}{2}/u;

/** The parts of an expression that may be its value, as far as they are written there. */
function valuesOf(expression: unknown): string[] {
  const node = (expression ?? {}) as Record<string, unknown> & { type?: string; value?: unknown };
  const { type } = node;
  if (type === 'Literal') return typeof node.value === 'string' ? [node.value] : [];
  if (type === 'ConditionalExpression') return [node['consequent'], node['alternate']].flatMap(valuesOf);
  if (type === 'LogicalExpression' || type === 'BinaryExpression') {
    return type === 'LogicalExpression' || node['operator'] === '+' ? [node['left'], node['right']].flatMap(valuesOf) : [];
  }
  if (type === 'TemplateElement') return [(node.value as { cooked: string }).cooked];
  if (type === 'TemplateLiteral') return [node['quasis'], node['expressions']].flatMap((parts) => (parts as unknown[]).flatMap(valuesOf));
  return [];
}

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
    if (type === 'ExpressionTag') {
      const { expression } = node as { expression?: unknown };
      found.push(...valuesOf(expression).filter((text) => WORD.test(text)));
    }
    if (type === 'Attribute') {
      if (name && READ.includes(name)) look(value);
      return;
    }
    for (const part of Object.values(node)) look(part);
  };
  look(parse(source, { modern: true }).fragment);
  return found;
}

test('components have no texts of their own', () => {
  expect(literals('<p title="A title">Two <b>{words}</b></p>')).toEqual(['A title', 'Two']);
  const expressions = "<p title={is ? 'A title' : ''} class={is ? 'bad' : ''}>{is && `Two ${texts.words}`}{say('it')}{is === 'so' ? texts.a : 'else'}</p>";
  expect(literals(expressions)).toEqual(['A title', 'Two ', 'else']);
  const files = ['App.svelte', ...readdirSync(new URL('parts/', SOURCES)).map((name) => `parts/${name}`)];
  expect(files.length).toBeGreaterThan(30);
  for (const file of files) expect(literals(readFileSync(new URL(file, SOURCES), 'utf8')), file).toEqual([]);
});

/** Two words beside each other are a text. */
const TEXT = /\p{L}{2} \p{L}{2}/u;
/** Texts of sources that nobody reads on the page, or that are in no language. */
const OF_PROGRAMS = [
  /^(\d+ )?\d+px system-ui, sans-serif$/,
  /^linear-gradient\(to right, /,
  /^tread(-agent)? |^ --token-file /,
  // What the server is given as the reason of a stop.
  /^(all )?stopped on the page$/,
  // The server's words with other numbers.
  /^ of point $/,
];

/** Texts in a source in TypeScript. */
function textsIn(source: string): string[] {
  const found: string[] = [];
  const look = (node: ts.Node): void => {
    if (ts.isStringLiteralLike(node) || ts.isTemplateHead(node) || ts.isTemplateMiddleOrTemplateTail(node)) found.push(node.text);
    node.forEachChild(look);
  };
  look(ts.createSourceFile('source.ts', source, ts.ScriptTarget.Latest));
  return found.filter((text) => TEXT.test(text) && !OF_PROGRAMS.some((known) => known.test(text)));
}

test('states and the map have no texts of their own', () => {
  expect(textsIn("const a = 'It failed.'; const b = `so ${it} is done`; const c = 'one';")).toEqual(['It failed.', ' is done']);
  const files = ['', 'api/', 'map/', 'state/'].flatMap((folder) =>
    readdirSync(new URL(folder || './', SOURCES))
      .filter((name) => /\.ts$/.test(name) && !/\.test\.ts$|\.d\.ts$/.test(name))
      .map((name) => folder + name),
  );
  expect(files.length).toBeGreaterThan(60);
  for (const file of files) expect(textsIn(readFileSync(new URL(file, SOURCES), 'utf8')), file).toEqual([]);
});
