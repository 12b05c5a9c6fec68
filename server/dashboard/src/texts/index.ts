// Every word of the page, in the language that is chosen: a change of it changes what is shown at once.
import type { Language } from '../locale';
import { preferences } from '../preferences.svelte';
import { de } from './de';
import { en, type Texts } from './en';

export type { Texts };

export const DICTIONARIES: Record<Language, Texts> = { en, de };

export const texts: Texts = new Proxy(en as Texts, {
  get: (_, area) => DICTIONARIES[preferences.language][area as keyof Texts],
});
