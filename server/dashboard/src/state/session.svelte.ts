// Who is signed in, and how the page looks to them.
import type { OidcSignIn, Right, Session, SignInMethods, SignedOut } from '../api/schema';
import { Problem, ask, saidOf, whenSignedOut } from '../api/client';
import type { Said } from '../message';
import { may } from '../rights';
import { texts } from '../texts';

const THEME_KEY = 'tread-theme';
/** Kept while this browser should have a session, so that others are not asked in vain. */
const SESSION_KEY = 'tread-session';
/** With this the server sends a browser here that has signed in at the provider. */
const SIGNED_IN = '#signed-in';

export type Theme = 'light' | 'dark';

/** A token, or a person at the provider. */
export type SignedInBy = 'token' | 'person';

export class SignedIn {
  session = $state<Session | null>(null);
  /** The provider that people may sign in at, if there is one. */
  oidc = $state<OidcSignIn | null>(null);
  /** Whether the server was asked already. */
  isKnown = $state(false);
  /** Somebody was signed in on this page and no longer is. */
  hasEnded = $state(false);
  /** How whoever signed out on this page had signed in; null unless somebody just did. */
  out = $state<SignedInBy | null>(null);
  problem = $state<Said | null>(null);

  constructor() {
    whenSignedOut(() => this.end());
  }

  /** Whether they have a right; with a site, whether they have it for all of this site. */
  may(right: Right, site?: string): boolean {
    return may(this.session, right, site);
  }

  get by(): SignedInBy {
    return this.session?.person ? 'person' : 'token';
  }

  get name(): string {
    return this.session?.name ?? '';
  }

  /** Asks whether this browser has a session. */
  async look(): Promise<void> {
    this.problem = null;
    if (location.hash === SIGNED_IN) {
      localStorage.setItem(SESSION_KEY, 'yes');
      history.replaceState(null, '', location.pathname);
    }
    if (localStorage.getItem(SESSION_KEY)) {
      try {
        this.session = await ask<Session>('/v1/session');
      } catch (error) {
        if (error instanceof Problem && error.status === 401) this.hasEnded = true;
        else this.problem = saidOf(error);
      }
    }
    this.isKnown = true;
    if (!this.session) await this.lookForWays();
  }

  /** Asks how people may sign in; a token is a way whatever the answer. */
  async lookForWays(): Promise<void> {
    try {
      this.oidc = (await ask<SignInMethods>('/v1/sign-in')).oidc ?? null;
    } catch {
      this.oidc = null;
    }
  }

  async signIn(token: string): Promise<void> {
    this.problem = null;
    try {
      this.session = await ask<Session>('/v1/session', { method: 'POST', body: { token } });
      this.hasEnded = false;
      this.out = null;
      localStorage.setItem(SESSION_KEY, 'yes');
    } catch (error) {
      // What the server says of it is for programs.
      this.problem = error instanceof Problem && error.status === 401 ? () => texts.signIn.wrong : saidOf(error);
    }
  }

  async signOut(): Promise<void> {
    this.problem = null;
    const { by } = this;
    try {
      const out = await ask<SignedOut | undefined>('/v1/session', { method: 'DELETE' });
      localStorage.removeItem(SESSION_KEY);
      this.session = null;
      this.out = by;
      if (out) location.assign(out.provider);
      else await this.lookForWays();
    } catch (error) {
      // It had ended already, which is said.
      if (!(error instanceof Problem && error.status === 401)) this.problem = saidOf(error);
    }
  }

  end(): void {
    if (this.session) this.hasEnded = true;
    this.out = null;
    this.problem = null;
    localStorage.removeItem(SESSION_KEY);
    this.session = null;
    void this.lookForWays();
  }
}

class Look {
  #fingers = matchMedia('(pointer: coarse)');
  /** Whether whoever looks points with fingers. */
  isTouch = $state(this.#fingers.matches);
  #narrow = matchMedia('(max-width: 760px)');
  /** Whether the map lies above the panel, as on phones. */
  isNarrow = $state(this.#narrow.matches);
  #system = matchMedia('(prefers-color-scheme: dark)');
  #wanted = $state<Theme | null>(localStorage.getItem(THEME_KEY) as Theme | null);
  #isDark = $state(this.#system.matches);

  constructor() {
    this.#system.addEventListener('change', (event) => (this.#isDark = event.matches));
    this.#fingers.addEventListener('change', (event) => (this.isTouch = event.matches));
    this.#narrow.addEventListener('change', (event) => (this.isNarrow = event.matches));
    this.#apply();
  }

  get theme(): Theme {
    return this.#wanted ?? (this.#isDark ? 'dark' : 'light');
  }

  toggle(): void {
    this.#wanted = this.theme === 'dark' ? 'light' : 'dark';
    localStorage.setItem(THEME_KEY, this.#wanted);
    this.#apply();
  }

  #apply(): void {
    if (this.#wanted) document.documentElement.dataset['theme'] = this.#wanted;
  }
}

export const signedIn = new SignedIn();
export const look = new Look();
