// Names of robot models for a list with little room. Pure.

export interface Named {
  name: string;
  tyres: string;
}

/** The name of a configuration among others: with its tyres only where another model has the same name. */
export function modelLabel(configuration: string, all: readonly string[], modelOf: (one: string) => Named | null): string {
  const model = modelOf(configuration);
  if (!model) return configuration.slice(0, 8);
  const isOne = all.every((other) => other === configuration || modelOf(other)?.name !== model.name);
  return isOne ? model.name : `${model.name}, ${model.tyres}`;
}
