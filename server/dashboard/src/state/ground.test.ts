import { afterEach, expect, test, vi } from 'vitest';
import { sentence } from '../api/client';
import type { Geofence, Terrain } from '../api/schema';
import { placeOf, addressOf, type DraftState, type Place } from '../address';
import { Editor } from './editor.svelte';
import type { Fleet } from './fleet.svelte';
import { deleteTerrain, replaceArea } from './ground';

const CORNERS = [
  { x_m: 0, y_m: 0 },
  { x_m: 4, y_m: 0 },
  { x_m: 4, y_m: 1 / 3 },
];
const lawn = (revision: number, changes: Partial<Terrain> = {}) =>
  ({ id: 'lawn', name: 'Lawn', class: 'grass', layer: 0, revision, polygon: CORNERS, ...changes }) as Terrain;

/** A server that keeps a terrain and a geofence by their revisions, and what it was asked. */
function server(stored: { terrain: Terrain; fence: Geofence }) {
  const asked: { method: string; path: string; ifMatch: string | undefined }[] = [];
  const reply = (body: unknown, status = 200) => new Response(status === 204 ? null : JSON.stringify(body), { status });
  vi.stubGlobal('fetch', async (path: string, init: RequestInit) => {
    const ifMatch = (init.headers as Record<string, string>)['if-match'];
    const method = init.method ?? 'GET';
    asked.push({ method, path, ifMatch });
    const what = path.endsWith('/geofence') ? 'fence' : 'terrain';
    const present = stored[what];
    if (method === 'GET') return reply(present);
    if (ifMatch !== undefined && ifMatch !== `"${present.revision}"`) {
      return reply({ type: '/problems/precondition-failed', title: 'it was changed', status: 412 }, 412);
    }
    if (method === 'DELETE') return reply(null, 204);
    const next = { ...present, ...JSON.parse(String(init.body)), revision: present.revision + 1 };
    Object.assign(stored, { [what]: next });
    return reply(next);
  });
  return { stored, asked };
}

function fleetOf(terrain: Terrain, fence: Geofence | null = null) {
  const fleet = {
    site: 'yard',
    terrains: [terrain],
    fence,
    isDirty: false,
    setTerrain: (saved: Terrain) => (fleet.terrains = [saved]),
    setFence: (saved: Geofence) => (fleet.fence = saved),
    readGround: async () => undefined,
  };
  return fleet;
}

const fenceOf = (revision: number, keep_out: Geofence['keep_out']) => ({ keep_in: [], keep_out, revision }) as unknown as Geofence;
const asFleet = (fleet: object) => fleet as unknown as Fleet;

afterEach(() => vi.unstubAllGlobals());

test('a terrain is not saved over what somebody else changed, and what was drawn stays', async () => {
  const { stored, asked } = server({ terrain: lawn(4, { class: 'ice' }), fence: fenceOf(1, []) });
  const fleet = fleetOf(lawn(3));
  const editor = new Editor(asFleet(fleet));
  editor.beginTerrain(fleet.terrains[0] ?? null);
  editor.terrainClass = 'snow';
  editor.draft?.add({ x_m: 0, y_m: 5 });
  expect(await editor.saveTerrain()).toBe(false);
  expect(asked[0]).toEqual({ method: 'PUT', path: '/v1/sites/yard/terrains/lawn', ifMatch: '"3"' });
  expect(stored.terrain.class).toBe('ice');
  expect(editor.conflict?.revision).toBe(4);
  expect(editor.sendProblem).toMatch(/^Somebody else changed Lawn meanwhile/);
  expect([editor.draft?.points.length, editor.terrainClass]).toEqual([4, 'snow']);
});

test('whoever has a conflict loads the new state or replaces it', async () => {
  const { stored } = server({ terrain: lawn(4, { class: 'ice' }), fence: fenceOf(1, []) });
  const fleet = fleetOf(lawn(3));
  const editor = new Editor(asFleet(fleet));
  const conflict = async () => {
    editor.beginTerrain(lawn(3));
    editor.terrainClass = 'snow';
    await editor.saveTerrain();
  };
  await conflict();
  editor.loadPresent();
  expect([editor.terrainClass, editor.conflict, editor.sendProblem]).toEqual(['ice', null, null]);
  expect(await editor.saveTerrain()).toBe(true);
  expect(stored.terrain.revision).toBe(5);
  await conflict();
  await editor.saveOver();
  expect([stored.terrain.class, stored.terrain.revision, editor.purpose, editor.discarded]).toEqual(['snow', 6, null, null]);
  expect(fleet.terrains[0]?.revision).toBe(6);
});

test('a draft that comes back from the address is a change of the revision that it was begun on', async () => {
  const { asked } = server({ terrain: lawn(4), fence: fenceOf(1, []) });
  const editor = new Editor(asFleet(fleetOf(lawn(3))));
  editor.beginTerrain(lawn(3));
  const place = { site: 'yard', tab: 'terrains', marked: [], hidden: [], draft: editor.state } as unknown as Place;
  const draft = placeOf(addressOf(place)).draft as DraftState;
  const reloaded = new Editor(asFleet(fleetOf(lawn(4))));
  expect(reloaded.goOnWith(draft)).toBe(true);
  expect(await reloaded.saveTerrain()).toBe(false);
  expect(asked[0]?.ifMatch).toBe('"3"');
});

test('a terrain that somebody else changed is not deleted', async () => {
  server({ terrain: lawn(4), fence: fenceOf(1, []) });
  const error = await deleteTerrain(asFleet(fleetOf(lawn(3))), lawn(3)).catch((error: unknown) => error);
  expect(sentence(error)).toMatch(/^It was not deleted: somebody else changed it/);
  await deleteTerrain(asFleet(fleetOf(lawn(4))), lawn(4));
});

test('an area of the geofence that somebody else changed is neither doubled nor deleted', async () => {
  const moved = CORNERS.map(({ x_m, y_m }) => ({ x_m: x_m + 1, y_m }));
  const { stored, asked } = server({ terrain: lawn(1), fence: fenceOf(8, [moved]) });
  const fleet = fleetOf(lawn(1), stored.fence);
  const editor = new Editor(asFleet(fleet));
  editor.beginFence('keep_out', CORNERS);
  expect(await editor.saveFence()).toBe(false);
  expect(asked).toEqual([]);
  expect(editor.sendProblem).toMatch(/^Somebody changed or deleted this area meanwhile/);
  const error = await replaceArea(asFleet(fleet), { side: 'keep_out', old: CORNERS, area: null }).catch((error: unknown) => error);
  expect(sentence(error)).toMatch(/^It was not deleted/);
  // Saved again it is one more.
  expect(await editor.saveFence()).toBe(true);
  expect(stored.fence.keep_out).toEqual([moved, CORNERS]);
});

test('an area of an address, which has fewer digits, is the same', async () => {
  const { stored } = server({ terrain: lawn(1), fence: fenceOf(8, [CORNERS]) });
  const rounded = CORNERS.map(({ x_m, y_m }) => ({ x_m, y_m: Number(y_m.toFixed(9)) }));
  await replaceArea(asFleet(fleetOf(lawn(1), stored.fence)), { side: 'keep_out', old: rounded, area: null });
  expect(stored.fence.keep_out).toEqual([]);
});

test('what was saved for a site that is no longer shown does not come to the other site', async () => {
  const { stored } = server({ terrain: lawn(3), fence: fenceOf(1, []) });
  const fleet = fleetOf(lawn(3));
  const other = lawn(9, { id: 'other' });
  const editor = new Editor(asFleet(fleet));
  editor.beginTerrain(lawn(3));
  const saving = editor.saveTerrain();
  Object.assign(fleet, { site: 'quarry', terrains: [other] });
  expect(await saving).toBe(true);
  expect([stored.terrain.revision, fleet.terrains]).toEqual([4, [other]]);
});
