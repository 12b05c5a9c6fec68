// What this browser shows everything in: the language, and the units of lengths, speeds and masses.
import { LANGUAGES, SYSTEMS, languageOf, localeOf, systemOf, type Language, type System } from './locale';

const KEYS = { language: 'tread-language', system: 'tread-units' } as const;

class Preferences {
  /** What the browser asks for, the best first. */
  readonly #locales = globalThis.navigator?.languages ?? [];
  #language = $state(kept(LANGUAGES, KEYS.language) ?? languageOf(this.#locales));
  #system = $state(kept(SYSTEMS, KEYS.system) ?? systemOf(this.#locales));

  constructor() {
    this.#apply();
  }

  get language(): Language {
    return this.#language;
  }

  set language(language: Language) {
    this.#language = language;
    localStorage.setItem(KEYS.language, language);
    this.#apply();
  }

  get system(): System {
    return this.#system;
  }

  set system(system: System) {
    this.#system = system;
    localStorage.setItem(KEYS.system, system);
  }

  /** The locale of numbers. */
  get locale(): string {
    return localeOf(this.#language, this.#locales);
  }

  #apply(): void {
    if (globalThis.document) document.documentElement.lang = this.#language;
  }
}

function kept<T extends string>(known: readonly T[], key: string): T | null {
  const value = globalThis.localStorage?.getItem(key);
  return known.find((name) => name === value) ?? null;
}

export const preferences = new Preferences();
