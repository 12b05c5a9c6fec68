// Saving and deleting terrains and areas of the geofence, never over what somebody else changed meanwhile.
import type { CreateTerrain, Geofence, ReplaceGeofence, ReplaceTerrain, Terrain } from '../api/schema';
import { Problem, ask } from '../api/client';
import type { PointM } from '../map/camera';
import { texts } from '../texts';
import type { Fleet } from './fleet.svelte';

/** The server has another revision than the one that was named. */
const PRECONDITION_FAILED = 412;
/** Corners that are this close are the same: addresses keep nine digits, metres. */
const SAME_M = 1e-8;

export type FenceSide = 'keep_in' | 'keep_out';

type Ground = Pick<Fleet, 'site' | 'fence' | 'setTerrain' | 'setFence' | 'readGround'>;

/** Somebody else changed a terrain while it was drawn. */
export class TerrainChanged extends Problem {
  constructor(
    /** The terrain as it is now. */
    readonly present: Terrain,
  ) {
    super(() => texts.terrains.changed(present.name, present.revision), PRECONDITION_FAILED);
  }
}

const isConflict = (error: unknown) => error instanceof Problem && error.status === PRECONDITION_FAILED;
const notDeleted = () => new Problem(() => texts.terrains.notDeleted, PRECONDITION_FAILED);
const ifMatch = ({ revision }: { revision: number }) => ({ 'if-match': `"${revision}"` });

/** Creates a terrain. */
export async function createTerrain(ground: Ground, body: CreateTerrain): Promise<void> {
  const { site } = ground;
  const made = await ask<Terrain>(`/v1/sites/${site}/terrains`, { method: 'POST', body });
  if (ground.site === site) ground.setTerrain(made);
}

/** Replaces a terrain; throws [`TerrainChanged`] if it is no longer the one that was drawn on. */
export async function replaceTerrain(ground: Ground, old: Terrain, body: ReplaceTerrain): Promise<void> {
  const { site } = ground;
  const path = `/v1/sites/${site}/terrains/${old.id}`;
  const keep = (terrain: Terrain) => {
    // Another site may be shown meanwhile.
    if (ground.site === site) ground.setTerrain(terrain);
  };
  try {
    keep(await ask<Terrain>(path, { method: 'PUT', body, headers: ifMatch(old) }));
  } catch (error) {
    if (!isConflict(error)) throw error;
    const present = await ask<Terrain>(path);
    keep(present);
    throw new TerrainChanged(present);
  }
}

/** Deletes a terrain, unless somebody changed it after it was shown. */
export async function deleteTerrain(ground: Ground, old: Terrain): Promise<void> {
  try {
    await ask(`/v1/sites/${ground.site}/terrains/${old.id}`, { method: 'DELETE', headers: ifMatch(old) });
  } catch (error) {
    throw isConflict(error) ? notDeleted() : error;
  } finally {
    void ground.readGround();
  }
}

/** One area of the geofence, and what takes its place; null for none. */
export interface FenceEdit {
  side: FenceSide;
  old: PointM[] | null;
  area: PointM[] | null;
}

/** Replaces one area of the geofence; throws if somebody changed the geofence or this area meanwhile. */
export async function replaceArea(ground: Ground, { side, old, area }: FenceEdit): Promise<void> {
  const { fence, site } = ground;
  if (!fence || !site) throw new Problem(() => texts.problem.lost, 0);
  const others = fence[side].filter((known) => !isSame(known, old));
  if (old && others.length === fence[side].length) throw area ? new AreaChanged() : notDeleted();
  const body: ReplaceGeofence = { keep_in: fence.keep_in, keep_out: fence.keep_out };
  body[side] = area ? [...others, area] : others;
  try {
    const saved = await ask<Geofence>(`/v1/sites/${site}/geofence`, { method: 'PUT', body, headers: ifMatch(fence) });
    if (ground.site === site) ground.setFence(saved);
  } catch (error) {
    if (!isConflict(error)) throw error;
    await ground.readGround();
    throw area ? new Problem(() => texts.fence.changed, PRECONDITION_FAILED) : notDeleted();
  }
}

/** Somebody else changed or deleted the area that was drawn on. */
export class AreaChanged extends Problem {
  constructor() {
    super(() => texts.fence.areaChanged, PRECONDITION_FAILED);
  }
}

function isSame(known: readonly PointM[], old: readonly PointM[] | null): boolean {
  if (old?.length !== known.length) return false;
  return known.every(({ x_m, y_m }, index) => Math.hypot(x_m - (old[index]?.x_m ?? NaN), y_m - (old[index]?.y_m ?? NaN)) < SAME_M);
}
