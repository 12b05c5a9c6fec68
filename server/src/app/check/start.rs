//! Predicts the pose from which a robot will start a new mission: the expected end of its active
//! and queued missions.

use tread_api::geometry::Pose;
use tread_api::ids::MissionId;
use tread_api::mission::{Mission, MissionState, StartPolicy};
use tread_api::robot::RobotModel;
use tread_api::trajectory::{StartSource, Trajectory};

use super::traction::Traction;
use super::{Planning, planned};
use crate::app::AppError;
use crate::db::missions::OpenMission;
use crate::db::{self, Tx};

/// Maximum number of earlier missions whose ends are planned. The end of a waypoint mission does
/// not depend on earlier ones, so more would only matter after as many circles.
const CHAIN_MAX: usize = 100;

/// Pose at which planning begins, and what it is derived from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Start {
    pub(super) pose: Pose,
    pub(super) source: StartSource,
    pub(super) after_mission: Option<MissionId>,
}

/// Position of a mission in its robot's queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) struct Place {
    pub(in crate::app) priority: i32,
    pub(in crate::app) policy: StartPolicy,
    /// The mission that it replaces, if any.
    pub(in crate::app) replaces: Option<MissionId>,
}

/// A mission that the robot drives before the new one.
#[derive(Debug)]
pub(super) struct PrecedingMission {
    id: MissionId,
    trajectory: Trajectory,
    /// Pose from which its robot planned it; `None` until the robot has accepted it.
    begin: Option<Pose>,
}

/// Returns whether this open mission is driven before one at `place`.
fn is_before(open: &OpenMission, place: Place) -> bool {
    match open.state {
        MissionState::Offered | MissionState::Active | MissionState::Paused => true,
        // A mission that is held in the queue is skipped.
        MissionState::Queued => {
            !open.pause_requested && (place.replaces.is_some() || open.priority >= place.priority)
        }
        // A mission that is being cancelled ends where the robot stops now.
        MissionState::Cancelling
        | MissionState::Succeeded
        | MissionState::Failed
        | MissionState::Cancelled
        | MissionState::Rejected
        | MissionState::Expired => false,
    }
}

/// Returns those of a robot's open missions, given in driving order, that are driven before one at
/// `place`.
fn before(open: &[OpenMission], place: Place) -> Vec<MissionId> {
    if place.policy == StartPolicy::Replace {
        return Vec::new();
    }
    let ahead = open
        .iter()
        .take_while(|open| Some(open.id) != place.replaces);
    let before = ahead.filter(|open| is_before(open, place));
    before.map(|open| open.id).collect()
}

/// Returns the missions whose ends determine the start of a new one, in driving order.
pub(super) async fn earlier(
    tx: &mut Tx,
    robot_pk: i64,
    place: Place,
) -> Result<Vec<PrecedingMission>, AppError> {
    let open = db::missions::open_of_robot(tx, robot_pk).await?;
    let mut chain = Vec::new();
    for id in before(&open, place).into_iter().rev().take(CHAIN_MAX) {
        let Some(row) = db::missions::find(tx, id).await? else {
            continue;
        };
        let earlier = PrecedingMission::of(row.mission);
        let says_its_end = matches!(earlier.trajectory, Trajectory::Waypoints(_));
        chain.push(earlier);
        if says_its_end {
            break;
        }
    }
    chain.reverse();
    Ok(chain)
}

impl PrecedingMission {
    pub(super) fn trajectory(&self) -> &Trajectory {
        &self.trajectory
    }

    fn of(mission: Mission) -> Self {
        let begin = mission.plan.and_then(|plan| plan.begin);
        match mission.replacement {
            // Its replacement is driven from wherever the robot is then.
            Some(replacement) => Self {
                id: mission.id,
                trajectory: replacement.trajectory,
                begin: None,
            },
            None => Self {
                id: mission.id,
                trajectory: mission.trajectory,
                begin,
            },
        }
    }
}

/// Returns the pose after those missions. Missions that cannot be planned are skipped: the robot
/// will refuse them and stay where it is.
pub(super) fn after(
    first: Start,
    earlier: &[(PrecedingMission, Traction)],
    model: &RobotModel,
) -> Start {
    earlier.iter().fold(first, |start, (mission, traction)| {
        let from = mission.begin.unwrap_or(start.pose);
        let planning = Planning {
            trajectory: &mission.trajectory,
            traction,
        };
        let Ok(planned) = planned(model, planning, from) else {
            return start;
        };
        let plan = &planned.plan;
        let end = plan.path().sample(plan.length_m()).pose;
        Start {
            pose: Pose {
                x_m: end.x_m,
                y_m: end.y_m,
                heading_rad: end.heading_rad,
            },
            source: StartSource::Mission,
            after_mission: Some(mission.id),
        }
    })
}

#[cfg(test)]
mod tests {
    use tread_api::ids::PlanHash;
    use tread_api::mission::LinkPolicy;
    use uuid::Uuid;

    use super::*;

    fn open(
        number: u128,
        state: MissionState,
        priority: i32,
        pause_requested: bool,
    ) -> OpenMission {
        OpenMission {
            id: MissionId::from_uuid(Uuid::from_u128(number)),
            site: "yard".parse().unwrap(),
            robot: "rover-1".parse().unwrap(),
            state,
            reason: None,
            boot: None,
            pause_requested,
            priority,
            content: (1, PlanHash::from_uuid(Uuid::from_u128(1))),
            replacement: None,
            silent_since: None,
            lost_after_s: None,
            link_policy: LinkPolicy::Continue,
            duration_s: None,
        }
    }

    #[test]
    fn a_new_mission_comes_after_what_is_driven_and_what_is_queued_with_at_least_its_priority() {
        use MissionState as S;
        let queue = [
            open(1, S::Active, -5, false),
            open(2, S::Queued, 9, false),
            open(3, S::Queued, 4, true),
            open(4, S::Queued, 4, false),
            open(5, S::Queued, 0, false),
        ];
        let ids = |place| -> Vec<u128> {
            let before = before(&queue, place).into_iter();
            before.map(|id| id.as_uuid().as_u128()).collect()
        };
        let place = |priority, policy, replaces: Option<u128>| Place {
            priority,
            policy,
            replaces: replaces.map(|number| MissionId::from_uuid(Uuid::from_u128(number))),
        };
        let append = |priority| ids(place(priority, StartPolicy::Append, None));
        assert_eq!(append(0), [1, 2, 4, 5]);
        assert_eq!(append(4), [1, 2, 4]);
        assert_eq!(append(10), [1]);
        assert_eq!(ids(place(0, StartPolicy::Replace, None)), []);
        // What takes the place of another one is driven when that would have been.
        assert_eq!(ids(place(0, StartPolicy::Append, Some(1))), []);
        assert_eq!(ids(place(0, StartPolicy::Append, Some(4))), [1, 2]);
        let cancelled = [open(1, S::Cancelling, 0, false)];
        assert_eq!(before(&cancelled, place(0, StartPolicy::Append, None)), []);
    }
}
