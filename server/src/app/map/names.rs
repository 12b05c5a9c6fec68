//! Database keys of what segments and sums name, and the sum of a stored segment.

use std::collections::HashMap;

use tread_api::ids::{ConfigurationId, RobotId};

use super::Folded;
use crate::db::segments::KeyedSegment;
use crate::db::sums::SumKey;
use crate::db::withdrawals::WithdrawalRow;
use crate::db::{self, DbError, Tx};
use crate::friction::{Sums, epoch_h};

/// Names of the database keys of robots and configurations that are on any map.
#[derive(Debug, Default)]
pub(super) struct KeyNames {
    robots: HashMap<i64, RobotId>,
    configurations: HashMap<i64, ConfigurationId>,
}

impl KeyNames {
    pub(super) fn record(&mut self, folded: &Folded) {
        let key = &folded.key;
        let robot = self.robots.entry(key.robot_pk);
        robot.or_insert_with(|| folded.robot.clone());
        self.configurations
            .entry(key.configuration_pk)
            .or_insert(folded.configuration);
    }

    pub(super) fn of(&self, key: &SumKey) -> Option<(&RobotId, ConfigurationId)> {
        let robot = self.robots.get(&key.robot_pk)?;
        let configuration = self.configurations.get(&key.configuration_pk)?;
        Some((robot, *configuration))
    }
}

/// Database keys of what a segment names.
#[derive(Debug, Default)]
pub(super) struct Names {
    robots: HashMap<i64, RobotId>,
    configurations: HashMap<i64, ConfigurationId>,
    withdrawals: Vec<WithdrawalRow>,
}

impl Names {
    pub(super) async fn read(tx: &mut Tx) -> Result<Self, DbError> {
        Ok(Self {
            robots: db::robots::ids_by_key(tx).await?,
            configurations: db::robots::configurations_by_key(tx).await?,
            withdrawals: db::withdrawals::all(tx).await?,
        })
    }

    /// Returns the number of the last withdrawal; 0 without any.
    pub(super) fn last_withdrawal(&self) -> i64 {
        self.withdrawals.last().map_or(0, |last| last.pk)
    }

    /// Returns the withdrawals after one of them, oldest first.
    pub(super) fn withdrawals_after(&self, after: i64) -> impl Iterator<Item = &WithdrawalRow> {
        self.withdrawals.iter().filter(move |row| row.pk > after)
    }

    pub(super) fn named(&self, key: SumKey, sums: Sums) -> Option<Folded> {
        Some(Folded {
            robot: self.robots.get(&key.robot_pk)?.clone(),
            configuration: *self.configurations.get(&key.configuration_pk)?,
            cells: vec![(key.cell, sums)],
            key,
        })
    }

    /// Returns the sum of a stored segment, as it was added before its receipt; `None` if it is
    /// withdrawn.
    pub(super) fn folded(&self, row: KeyedSegment) -> Result<Option<Folded>, DbError> {
        let KeyedSegment {
            pk,
            range_pk: _,
            robot_pk,
            robot,
            site_pk,
            configuration_pk,
            segment,
        } = row;
        // It was checked in the transaction that stored it.
        let sums = Sums::of(&segment).ok_or_else(|| DbError::Corrupt {
            what: "measurement out of range",
            value: pk.to_string(),
        })?;
        let key = SumKey {
            robot_pk,
            epoch_h: epoch_h(segment.ended_at),
            cell: segment.cell,
            terrain: segment.terrain,
            grid_revision: segment.grid_revision,
            site_pk,
            configuration_pk,
        };
        let mut withdrawals = self.withdrawals.iter();
        if withdrawals.any(|row| row.robot_pk == robot_pk && row.hours.contains(key.epoch_h)) {
            return Ok(None);
        }
        Ok(Some(Folded {
            robot,
            configuration: segment.configuration,
            cells: vec![(key.cell, sums)],
            key,
        }))
    }
}
