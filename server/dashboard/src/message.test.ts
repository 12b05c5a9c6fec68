import { readFileSync, readdirSync } from 'node:fs';
import { expect, test, vi } from 'vitest';
import type { ProblemBody } from './api/schema';
import { ask, describe, saidOf } from './api/client';
import { splitMessage, withDetail } from './message';
import { preferences } from './preferences.svelte';

test('a sentence and what the server adds are separated again, also within another sentence', () => {
  expect(splitMessage(withDetail('The path leaves the geofence.', 'at 3.2 m'))).toEqual({
    sentence: 'The path leaves the geofence.',
    detail: 'at 3.2 m',
  });
  expect(splitMessage(withDetail('Alone.', null))).toEqual({ sentence: 'Alone.', detail: null });
  expect(splitMessage(`rover-1: not stopped. ${withDetail('The robot is unknown.', 'no robot `rover-1`')}`)).toEqual({
    sentence: 'rover-1: not stopped. The robot is unknown.',
    detail: 'no robot `rover-1`',
  });
});

test('a problem is a sentence by its type, and the words of the server are its detail', () => {
  const body = { type: '/problems/unknown-robot', title: 'the robot is not known', status: 404, detail: 'no `rover-9`' };
  expect(splitMessage(describe(body as ProblemBody))).toEqual({ sentence: 'The robot is not known.', detail: 'no `rover-9`' });
});

test('what is kept follows the language of the page', async () => {
  vi.stubGlobal('localStorage', { setItem: () => undefined });
  vi.stubGlobal('document', { documentElement: {} });
  const body = { type: '/problems/unknown-robot', title: 'the robot is not known', status: 404, detail: 'no `rover-9`' } as ProblemBody;
  vi.stubGlobal('fetch', async () => Response.json(body, { status: 404 }));
  const kept = saidOf(await ask('/v1/sites/yard/robots/rover-9').catch((error: unknown) => error));
  vi.stubGlobal('fetch', () => Promise.reject(new TypeError('network')));
  const lost = saidOf(await ask('/v1/sites').catch((error: unknown) => error));
  preferences.language = 'de';
  expect(splitMessage(kept())).toEqual({ sentence: 'Der Roboter ist nicht bekannt.', detail: 'no `rover-9`' });
  expect(lost()).toMatch(/^Der Server antwortet nicht/);
  preferences.language = 'en';
  expect(splitMessage(kept())).toEqual({ sentence: 'The robot is not known.', detail: 'no `rover-9`' });
  vi.unstubAllGlobals();
});

test('no state and no component keeps a sentence of one language', () => {
  const folders = ['state/', 'parts/'].map((name) => new URL(name, import.meta.url));
  const sources = folders.flatMap((folder) => readdirSync(folder).map((name) => [name, readFileSync(new URL(name, folder), 'utf8')] as const));
  const kept = sources.flatMap(([name, text]) =>
    [...text.matchAll(/^.*(?:\b(?:this\.)?\w*(?:[pP]roblem|said)s?(?:\[[^\]]*\])? (?:\?\?)?= |\$state\()(?:texts\.|sentence\().*$/gm)]
      .map(([line]) => `${name}: ${line.trim()}`)
      // What is sent on at once is not kept.
      .filter((line) => !line.includes(': const ')),
  );
  expect(sources.length).toBeGreaterThan(60);
  expect(kept).toEqual([]);
});
