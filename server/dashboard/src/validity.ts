// What the page says of a field that is left empty or out of its range. Browsers say it in their own language, which
// need not be that of the page.
import { plain } from './format';
import { texts } from './texts';

/** A field of a form, as far as it says what is wrong with it. */
export interface Field {
  readonly validity: Partial<ValidityState>;
  readonly min: string;
  readonly max: string;
  readonly title: string;
  setCustomValidity(said: string): void;
}

/** What is wrong with a field, in the language of the page. */
export function flawOf({ validity, min, max, title }: Omit<Field, 'setCustomValidity'>): string {
  const { form } = texts;
  if (validity.valueMissing) return form.missing;
  if (validity.badInput) return form.number;
  if (validity.typeMismatch) return form.address;
  if (validity.patternMismatch && title) return form.pattern(title);
  if (validity.rangeUnderflow) return form.least(plain(Number(min)));
  if (validity.rangeOverflow) return form.most(plain(Number(max)));
  if (validity.stepMismatch) return form.whole;
  return form.wrong;
}

const isField = (target: unknown): target is Field & Element =>
  typeof target === 'object' && target !== null && 'validity' in target && 'setCustomValidity' in target;

/** Lets the fields of all forms speak the language of the page. */
export function speakForFields(page: Document): void {
  const forget = (target: unknown) => {
    if (isField(target)) target.setCustomValidity('');
  };
  page.addEventListener(
    'invalid',
    ({ target }) => {
      if (!isField(target)) return;
      // What was said of it last is no flaw of its own.
      target.setCustomValidity('');
      target.setCustomValidity(flawOf(target));
    },
    true,
  );
  page.addEventListener('input', ({ target }) => forget(target), true);
  // A field may have been filled by the page meanwhile. Enter in a field clicks the button of its form, too.
  page.addEventListener(
    'click',
    ({ target }) => {
      const button = target instanceof Element ? target.closest('button') : null;
      for (const field of button?.form?.elements ?? []) forget(field);
    },
    true,
  );
}
