import { expect, test } from 'vitest';
import type { Session } from './api/schema';
import { may, rightsOf } from './rights';

const session = (rights: Session['rights'], sites: Exclude<Session['sites'], undefined>): Session => ({
  name: 'desk',
  role: null,
  rights,
  sites,
  grants: [{ rights, sites }],
  person: null,
  token: '0192f0c1-2b3c-7d4e-8f50-617283940a1b',
  session: null,
  expires_at: '2027-01-01T00:00:00Z',
});

test('a right is there or not, whatever others there are', () => {
  const driver = session(['stop', 'read', 'drive'], null);
  expect(may(driver, 'drive')).toBe(true);
  expect(may(driver, 'dispatch')).toBe(false);
  expect(may(driver, 'drive', 'yard')).toBe(true);
  expect(may(null, 'read')).toBe(false);
});

test('what changes a site takes all of it', () => {
  const limited = session(['stop', 'read', 'configure'], [{ site: 'yard', robots: ['rover-1'] }, { site: 'field' }]);
  expect(may(limited, 'configure')).toBe(true);
  expect(may(limited, 'configure', 'yard')).toBe(false);
  expect(may(limited, 'configure', 'field')).toBe(true);
  expect(may(limited, 'configure', 'park')).toBe(false);
});

test('a server that tells no rights is taken by its roles', () => {
  const { rights: _, grants: __, ...before } = session([], null);
  const old = { ...before, role: 'operator' } as Session;
  expect(may(old, 'dispatch', 'yard')).toBe(true);
  expect(may(old, 'administer')).toBe(false);
  expect(rightsOf({ ...old, role: 'viewer' })).toEqual(['stop', 'read']);
  expect(rightsOf({ ...old, role: null })).toEqual([]);
});

test('of several groups each counts for itself', () => {
  const watcher: Session['grants'] = [
    { rights: ['stop', 'read'], sites: null },
    { rights: ['stop', 'read', 'configure'], sites: [{ site: 'yard' }] },
  ];
  const both = { ...session(['stop', 'read'], null), grants: watcher };
  expect(may(both, 'configure')).toBe(true);
  expect(may(both, 'configure', 'yard')).toBe(true);
  expect(may(both, 'configure', 'field')).toBe(false);
  expect(may(both, 'read', 'field')).toBe(true);
});
