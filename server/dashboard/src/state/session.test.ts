import { afterEach, beforeAll, expect, test, vi } from 'vitest';
import type { Session } from '../api/schema';
import { DICTIONARIES } from '../texts';
import type { SignedIn } from './session.svelte';

const TOKEN = { name: 'desk', person: null, token: 't' } as unknown as Session;
const PERSON = { name: 'oidc:Ada', person: { id: 'p' }, token: null } as unknown as Session;

let make: () => SignedIn;
beforeAll(async () => {
  const kept = new Map<string, string>();
  vi.stubGlobal('localStorage', {
    getItem: (key: string) => kept.get(key) ?? null,
    setItem: (key: string, value: string) => kept.set(key, value),
    removeItem: (key: string) => kept.delete(key),
  });
  vi.stubGlobal('matchMedia', () => ({ matches: false, addEventListener: () => undefined }));
  const { SignedIn } = await import('./session.svelte');
  make = () => new SignedIn();
});

/** Answers of the server by method; what else is asked for has an empty one. */
function answers(to: Record<string, () => Response>) {
  const left: string[] = [];
  vi.stubGlobal('location', { assign: (address: string) => left.push(address) });
  vi.stubGlobal('fetch', async (_path: string, init: RequestInit) => to[init.method ?? 'GET']?.() ?? Response.json({}));
  return left;
}

const signedIn = (session: Session) => {
  const one = make();
  one.session = session;
  return one;
};

afterEach(() => vi.clearAllMocks());

test('whoever signs out with a token is out in this browser, and hears that the token stays valid', async () => {
  const left = answers({ DELETE: () => new Response(null, { status: 204 }) });
  const one = signedIn(TOKEN);
  expect(one.by).toBe('token');
  await one.signOut();
  expect([one.session, one.out, one.hasEnded, left]).toEqual([null, 'token', false, []]);
  for (const { signIn } of Object.values(DICTIONARIES)) {
    expect(signIn.isOut.token).toMatch(/token/i);
    expect(signIn.outMeans.token).toMatch(/token/i);
    expect(signIn.isOut.person + signIn.outMeans.person).not.toMatch(/token/i);
  }
});

test('a person’s session ends, and the browser goes to the provider if that signs people out', async () => {
  const provider = 'https://id.example/end';
  const left = answers({ DELETE: () => Response.json({ provider }) });
  const one = signedIn(PERSON);
  await one.signOut();
  expect([one.session, one.out, left]).toEqual([null, 'person', [provider]]);
  const stays = answers({ DELETE: () => new Response(null, { status: 204 }) });
  const other = signedIn(PERSON);
  await other.signOut();
  expect([other.session, other.out, stays]).toEqual([null, 'person', []]);
});

test('a sign-out that does not reach the server leaves everybody signed in, and says so', async () => {
  answers({
    DELETE: () => {
      throw new TypeError('network');
    },
  });
  const one = signedIn(TOKEN);
  await one.signOut();
  expect([one.session, one.out]).toEqual([TOKEN, null]);
  expect(one.problem).not.toBeNull();
});

test('a session that had ended already is no failure of the sign-out', async () => {
  answers({ DELETE: () => Response.json({ type: '/problems/unauthenticated', title: 'a token is needed', status: 401 }, { status: 401 }) });
  const one = signedIn(TOKEN);
  await one.signOut();
  expect([one.session, one.problem, one.hasEnded]).toEqual([null, null, true]);
});
