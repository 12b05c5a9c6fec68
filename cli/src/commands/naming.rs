//! Finds the missions that a user names by a part of their identifiers.

use tread_api::ids::{MissionId, SiteId};

use crate::args::MissionName;
use crate::client::{Client, ClientError};

/// Returns the identifier of the mission with this name.
///
/// # Errors
/// [`ClientError::NoSuchMission`] and [`ClientError::AmbiguousMission`] if the part fits none or
/// several missions of the site; any other error of the request for them.
pub(super) async fn mission_id(
    client: &Client,
    site: &SiteId,
    name: &MissionName,
) -> Result<MissionId, ClientError> {
    if let MissionName::Whole(mission_id) = name {
        return Ok(*mission_id);
    }
    let missions = client.all_missions(site).await?;
    let fitting: Vec<_> = missions
        .iter()
        .filter(|mission| name.fits(mission.id))
        .collect();
    match fitting[..] {
        [mission] => Ok(mission.id),
        [] => Err(ClientError::NoSuchMission {
            part: name.to_string(),
            site: site.to_string(),
            read: missions.len(),
        }),
        [..] => Err(ClientError::AmbiguousMission {
            part: name.to_string(),
            candidates: fitting
                .iter()
                .map(|mission| {
                    format!(
                        "{} {} {}",
                        mission.id,
                        mission.robot,
                        mission.state.as_str()
                    )
                })
                .collect(),
        }),
    }
}
