// The English dictionary, and with it the shape of every other one.
import type { ProblemType, Session } from '../api/schema';
import { rightsOf } from '../rights';
import { fleet } from './en_fleet';
import { ground } from './en_ground';
import { limit, right, role, standstill } from './en_words';

export const en = {
  name: 'Tread',
  problem: {
    lost: 'The server does not answer; what you entered is kept.',
    unreadable: (status: number) => `The server answered with status ${status} and nothing readable.`,
    /** What a type of problem is called; what the server calls it is English. */
    title: (_type: ProblemType, said: string) => said,
  },
  rights: (session: Session) =>
    session.role
      ? role[session.role]
      : rightsOf(session)
          .map((one) => right[one])
          .join(', '),
  standstill,
  limitNames: limit,
  ...fleet,
  ...ground,
  /** What is wrong with a field of a form. */
  form: {
    missing: 'Fill in this field.',
    number: 'Enter a number.',
    address: 'Enter an address that begins with https://.',
    pattern: (hint: string) => `This field takes ${hint}.`,
    least: (least: string) => `Enter ${least} or more.`,
    most: (most: string) => `Enter ${most} or less.`,
    whole: 'Enter a whole number.',
    wrong: 'This field has a wrong value.',
  },
  unit: { s: 's', percent: '%', ms: 'ms', deg: '°', h: 'h', d: 'd', min: 'min', radps: 'rad/s', volt: 'V' },
  /** Two numbers beside each other; where a comma is decimal, it cannot part them. */
  pair: (first: string, second: string) => `${first}, ${second}`,
  unknown: '–',
};

/** The shape of a dictionary: what is a text in English may be any text elsewhere. */
type Shape<T> = T extends string
  ? string
  : T extends (...of: infer Of) => string
    ? (...of: Of) => string
    : { readonly [Key in keyof T]: Shape<T[Key]> };

export type Texts = Shape<typeof en>;
