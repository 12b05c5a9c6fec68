//! Enrolment of robots: joining the fleet, renewal of certificates, revocation, and rotation of the
//! fleet's certificate authority.
//!
//! A robot generates its private key itself and never sends it. With a join token, which is valid
//! for one use, it requests a certificate; with that certificate and key it requests the next one.

use std::fmt;
use std::num::ParseIntError;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use utoipa::ToSchema;

use crate::ids::{JoinTokenId, RobotId, SiteId};

/// Maximum validity of a join token, minutes: one day.
pub const JOIN_MINUTES_MAX: u32 = 24 * 60;
/// Default validity of a join token, minutes.
pub const JOIN_MINUTES_DEFAULT: u32 = 60;
/// Prefix of the message that proves a renewal. It ensures that no signature made for another
/// purpose is valid as a proof.
pub const RENEWAL_CONTEXT: &[u8] = b"tread: the next certificate for this request\n";

/// Returns the message that a robot signs with its present key to renew its certificate:
/// [`RENEWAL_CONTEXT`] and the certificate request.
pub fn renewal_message(certificate_request: &str) -> Vec<u8> {
    [RENEWAL_CONTEXT, certificate_request.as_bytes()].concat()
}

/// Join token, valid for one enrolment of one robot, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct JoinToken {
    /// Identifier of the token; not secret.
    pub id: JoinTokenId,
    /// Site that the robot joins.
    pub site: SiteId,
    /// Robot that the token is for; `null` for any robot that is new to the site.
    pub robot: Option<RobotId>,
    /// Time when the token was created.
    pub created_at: Timestamp,
    /// Name of the token or person that created it.
    pub created_by: String,
    /// Time from which the token is refused.
    pub expires_at: Timestamp,
    /// Time when a robot joined with the token; `null` while it is unused.
    pub used_at: Option<Timestamp>,
    /// Robot that joined with the token; `null` while it is unused.
    pub used_by: Option<RobotId>,
    /// Time when the token was revoked; `null` if it was not.
    pub revoked_at: Option<Timestamp>,
}

/// Request for a join token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateJoinToken {
    /// Site that the robot joins.
    pub site: SiteId,
    /// Robot that the token is for. When absent, any robot that is new to the site may join; a
    /// robot that the site knows, also a revoked one, must be named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// Validity of the token, minutes, 1 to 1440; 60 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_minutes: Option<u32>,
}

/// New join token with its secret, which no other response contains.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedJoinToken {
    /// The join token.
    pub join_token: JoinToken,
    /// Secret that the robot sends as `token` of its enrolment request.
    pub secret: String,
}

impl fmt::Debug for CreatedJoinToken {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("CreatedJoinToken")
            .field("join_token", &self.join_token)
            .finish_non_exhaustive()
    }
}

/// Request of a robot to join the fleet.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct EnrolRobot {
    /// Secret of a join token.
    pub token: String,
    /// Identifier of the robot; may be absent if the join token names a robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// PKCS #10 certificate request for the robot's key, PEM. Only its public key is used; the
    /// server sets the names in the certificate.
    pub certificate_request: String,
}

impl fmt::Debug for EnrolRobot {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("EnrolRobot")
            .field("robot", &self.robot)
            .finish_non_exhaustive()
    }
}

/// Request of a robot for its next certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RenewCertificate {
    /// Present certificate of the robot, PEM.
    pub certificate: String,
    /// PKCS #10 certificate request for the robot's next key, PEM, signed with that key.
    pub certificate_request: String,
    /// Signature that proves possession of the present key: ECDSA P-256 over the bytes `tread: the
    /// next certificate for this request`, a line feed and `certificate_request`; ASN.1 DER in
    /// base64.
    pub proof: String,
}

/// Certificate of a robot, the response to each enrolment and renewal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RobotCertificate {
    /// Site of the robot.
    pub site: SiteId,
    /// Identifier of the robot.
    pub robot: RobotId,
    /// Number of this enrolment of the robot, from 1. Certificates of earlier enrolments are
    /// refused.
    pub enrolment: u32,
    /// Certificate of the robot, PEM.
    pub certificate: String,
    /// Certificates of the authorities that the robot must trust on the robots' port, PEM: the
    /// fleet's authority, and during a rotation also the former one behind it.
    pub authority: String,
    /// Remaining validity of the certificate, seconds from now. Renew it after two thirds of this
    /// time.
    pub lifetime_s: u64,
    /// Time from which the certificate is refused.
    pub expires_at: Timestamp,
    /// TCP port of the server for robots.
    pub port: u16,
}

/// One enrolment of a robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Enrolment {
    /// Site of the robot.
    pub site: SiteId,
    /// Identifier of the robot.
    pub robot: RobotId,
    /// Number of this enrolment of the robot, from 1.
    pub number: u32,
    /// Time when the robot joined.
    pub enrolled_at: Timestamp,
    /// Join token that the robot used.
    pub join_token: JoinTokenId,
    /// Time when the robot's present certificate was issued.
    pub renewed_at: Timestamp,
    /// Time from which the present certificate is refused.
    pub expires_at: Timestamp,
    /// Time when the enrolment was revoked, or replaced because the robot joined again; `null`
    /// while it is valid.
    pub revoked_at: Option<Timestamp>,
    /// Name of the token or person that revoked or replaced it; `null` while it is valid.
    pub revoked_by: Option<String>,
    /// SHA-256 fingerprint of the authority that signed the certificate which the robot presented
    /// last. During a rotation it shows which robots use the new authority. `null` if the server
    /// has not recorded a certificate of the robot yet.
    #[serde(default)]
    pub authority: Option<String>,
}

/// Identifier of the set of authorities that a robot trusts: the first 64 bits of a SHA-256 hash.
/// Server and robot compare it to detect that they trust different sets. It is a hint and proves
/// nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TrustId(u64);

impl TrustId {
    /// Returns the identifier of a set of certificates, each as DER. Order and duplicates do not
    /// matter.
    pub fn of<'der>(certificates: impl IntoIterator<Item = &'der [u8]>) -> Self {
        let mut hashes: Vec<[u8; 32]> = certificates
            .into_iter()
            .map(|der| Sha256::digest(der).into())
            .collect();
        hashes.sort_unstable();
        hashes.dedup();
        let whole: [u8; 32] = Sha256::digest(hashes.concat()).into();
        let mut upper = [0; 8];
        upper.copy_from_slice(&whole[..8]);
        Self(u64::from_be_bytes(upper))
    }

    /// Returns the identifier as an integer; its bits are uniformly distributed.
    pub const fn bits(self) -> u64 {
        self.0
    }
}

impl fmt::Display for TrustId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:016x}", self.0)
    }
}

impl FromStr for TrustId {
    type Err = ParseIntError;

    fn from_str(text: &str) -> Result<Self, ParseIntError> {
        u64::from_str_radix(text, 16).map(Self)
    }
}

impl Serialize for TrustId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for TrustId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// Certificate authority of the fleet, and the state of its rotation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FleetAuthority {
    /// SHA-256 fingerprint of the certificate of the authority that signs robots' certificates.
    pub signing: String,
    /// Rotation in progress; `null` if there is none.
    pub rotation: Option<AuthorityRotation>,
    /// Whether the disk has confirmed that the former authority is retired. While this is false the
    /// retirement is in force, but a power failure may undo it; the server retries the write by
    /// itself.
    pub on_disk: bool,
    /// Number of robots that must join again, because a retired authority signed the certificate
    /// that they presented last.
    pub robots_to_join: u32,
    /// Robots that must join again, at most the first 1000.
    pub to_join: Vec<RobotLeft>,
}

/// Rotation of the fleet's authority, during which the new and the former authority are trusted and
/// the new one signs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuthorityRotation {
    /// Identifier of the rotation, required to finish it.
    #[schema(value_type = String)]
    pub id: TrustId,
    /// SHA-256 fingerprint of the certificate of the authority that will be retired.
    pub retiring: String,
    /// Time when the rotation was started.
    pub started_at: Timestamp,
    /// Name of the token or person that started the rotation.
    pub started_by: String,
    /// Number of robots that have presented a certificate of the new authority.
    pub robots_moved: u32,
    /// Number of robots that have not presented one. They must join again once the former authority
    /// is retired.
    pub robots_left: u32,
    /// Robots that have not presented a certificate of the new authority, at most the first 1000.
    pub left: Vec<RobotLeft>,
}

/// Robot whose certificate was signed by an authority that is retired, or will be.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RobotLeft {
    /// Site of the robot.
    pub site: SiteId,
    /// Identifier of the robot.
    pub robot: RobotId,
    /// Time when its certificate was issued.
    pub renewed_at: Timestamp,
    /// Whether the robot is online now.
    pub online: bool,
}

/// Request to finish a rotation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FinishRotation {
    /// Identifier of the rotation: `id` in the response to its start.
    #[schema(value_type = String)]
    pub rotation: TrustId,
    /// Whether to retire the former authority although robots still hold certificates of it; these
    /// robots must join again. When false, the request is refused while such robots exist.
    #[serde(default)]
    pub force: bool,
}

/// Request to replace the fleet's authority at once, without a rotation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceAuthority {
    /// SHA-256 fingerprint of the authority to replace: `signing` of the present authority. The
    /// request is refused if another authority signs meanwhile.
    pub signing: String,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_trust_id_names_a_set_whatever_its_order(
            mut certificates in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..20), 0..4),
            another in prop::collection::vec(any::<u8>(), 21..30),
        ) {
            let of = |all: &[Vec<u8>]| TrustId::of(all.iter().map(Vec::as_slice));
            let id = of(&certificates);
            certificates.reverse();
            prop_assert_eq!(of(&certificates), id);
            let json = serde_json::to_string(&id).unwrap();
            prop_assert_eq!(serde_json::from_str::<TrustId>(&json).unwrap(), id);
            certificates.push(another);
            prop_assert_ne!(of(&certificates), id);
        }
    }
}
