//! Interns the names of robots, configurations and terrains as short numbers.

use std::collections::BTreeMap;

use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::terrain::TerrainRef;

/// Number of a robot, configuration or terrain: its index in [`Names`].
pub(super) type Number = u32;

/// Interned names of robots, configurations and terrains.
#[derive(Debug, Clone, Default)]
pub(super) struct Names {
    pub(super) robots: Interner<RobotId>,
    pub(super) configurations: Interner<ConfigurationId>,
    pub(super) terrains: Interner<Option<TerrainRef>>,
}

#[derive(Debug, Clone)]
pub(super) struct Interner<T> {
    pub(super) numbers: BTreeMap<T, Number>,
    pub(super) names: Vec<T>,
    /// Rank of each number in the order of names, which does not depend on the order of insertion.
    ranks: Vec<u32>,
}

impl<T> Default for Interner<T> {
    fn default() -> Self {
        Self {
            numbers: BTreeMap::new(),
            names: Vec::new(),
            ranks: Vec::new(),
        }
    }
}

impl<T: Ord + Clone> Interner<T> {
    pub(super) fn number(&mut self, name: &T) -> Number {
        if let Some(&number) = self.numbers.get(name) {
            return number;
        }
        let number = Number::try_from(self.names.len()).unwrap_or(Number::MAX);
        self.names.push(name.clone());
        self.numbers.insert(name.clone(), number);
        self.ranks.resize(self.names.len(), 0);
        for (&number, rank) in self.numbers.values().zip(0..) {
            self.ranks[number as usize] = rank;
        }
        number
    }

    /// Returns the number of a name; `None` if the name is new.
    pub(super) fn find(&self, name: &T) -> Option<Number> {
        self.numbers.get(name).copied()
    }

    pub(super) fn name(&self, number: Number) -> &T {
        &self.names[number as usize]
    }

    pub(super) fn rank(&self, number: Number) -> u32 {
        self.ranks[number as usize]
    }
}
