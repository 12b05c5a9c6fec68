// What whoever is signed in may do, and where: what the server would refuse is not offered.
import type { Right, Session } from './api/schema';

/** Whether a session has a right; with a site, whether it has it for all of this site. */
export function may(session: Session | null, right: Right, site?: string): boolean {
  if (!session?.rights.includes(right)) return false;
  if (site === undefined || !session.sites) return true;
  return session.sites.some((scope) => scope.site === site && !scope.robots);
}
