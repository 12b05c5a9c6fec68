// The German dictionary.
import { rightsOf } from '../rights';
import type { Texts } from './en';
import { fleet } from './de_fleet';
import { ground } from './de_ground';
import { limit, problemTitles, right, role, standstill } from './de_words';

export const de: Texts = {
  name: 'Tread',
  problem: {
    lost: 'Der Server antwortet nicht; Ihre Eingaben bleiben erhalten.',
    unreadable: (status) => `Der Server hat mit Status ${status} und nichts Lesbarem geantwortet.`,
    title: (type, said) => problemTitles[type] ?? said,
  },
  rights: (session) =>
    session.role
      ? role[session.role]
      : rightsOf(session)
          .map((one) => right[one])
          .join(', '),
  standstill,
  limitNames: limit,
  ...fleet,
  ...ground,
  form: {
    missing: 'Füllen Sie dieses Feld aus.',
    number: 'Geben Sie eine Zahl ein.',
    address: 'Geben Sie eine Adresse ein, die mit https:// beginnt.',
    pattern: (hint) => `Möglich sind hier: ${hint}.`,
    least: (least) => `Geben Sie ${least} oder mehr ein.`,
    most: (most) => `Geben Sie ${most} oder weniger ein.`,
    whole: 'Geben Sie eine ganze Zahl ein.',
    wrong: 'Dieses Feld hat einen falschen Wert.',
  },
  unit: { s: 's', percent: '%', ms: 'ms', deg: '°', h: 'h', d: 'd', min: 'min', radps: 'rad/s', volt: 'V' },
  pair: (first, second) => `${first}; ${second}`,
  unknown: '–',
};
