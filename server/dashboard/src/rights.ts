// What whoever is signed in may do, and where: what the server would refuse is not offered.
import type { Grant, Right, Session } from './api/schema';

/** What the roles may do, for answers of servers that have no rights yet. */
const everything: readonly Right[] = [
  'stop',
  'read',
  'drive',
  'clear_stop',
  'hold',
  'release_hold',
  'dispatch',
  'acknowledge',
  'configure',
  'administer',
];
const ofRole = { viewer: ['stop', 'read'], operator: everything.slice(0, -1), admin: everything } as const;

/** What a session may do, each with where. */
function grantsOf(session: Session): readonly Grant[] {
  const stated: readonly Grant[] | undefined = session.grants;
  const rights: readonly Right[] | undefined = session.rights;
  const ofAll = () => rights ?? (session.role ? ofRole[session.role] : []);
  return stated ?? [{ rights: [...ofAll()], sites: session.sites }];
}

/** What a session may do somewhere. */
export function rightsOf(session: Session): readonly Right[] {
  return [...new Set(grantsOf(session).flatMap((grant) => grant.rights))];
}

/** Whether a session has a right; with a site, whether it has it for all of this site. */
export function may(session: Session | null, right: Right, site?: string): boolean {
  const holds = (grant: Grant) =>
    grant.rights.includes(right) &&
    (site === undefined || !grant.sites || grant.sites.some((scope) => scope.site === site && !scope.robots));
  return session ? grantsOf(session).some(holds) : false;
}
