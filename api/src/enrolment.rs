//! How robots join the fleet, stay in it, and are put out of it.
//!
//! A robot makes its key itself and never shows it. With a join token, which counts once, it asks
//! for a certificate; with that certificate and key it asks for the next one.

use std::fmt;
use std::num::ParseIntError;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use utoipa::ToSchema;

use crate::ids::{JoinTokenId, RobotId, SiteId};

/// Most minutes that a join token may be valid: a day.
pub const JOIN_MINUTES_MAX: u32 = 24 * 60;
/// Minutes that a join token is valid when nothing is said.
pub const JOIN_MINUTES_DEFAULT: u32 = 60;
/// What the proof of a renewal is about, before the request's own text: no signature that was
/// made for another purpose counts as one.
pub const RENEWAL_CONTEXT: &[u8] = b"tread: the next certificate for this request\n";

/// What a robot signs with its present key to get its next certificate.
pub fn renewal_message(certificate_request: &str) -> Vec<u8> {
    [RENEWAL_CONTEXT, certificate_request.as_bytes()].concat()
}

/// A token by which one robot may join once, as it is listed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct JoinToken {
    /// Its identifier; no secret.
    pub id: JoinTokenId,
    /// The site that the robot joins.
    pub site: SiteId,
    /// The robot that it is for; `null` for any that is new.
    pub robot: Option<RobotId>,
    /// When it was made.
    pub created_at: Timestamp,
    /// Who made it.
    pub created_by: String,
    /// From when on it is refused.
    pub expires_at: Timestamp,
    /// When a robot joined by it.
    pub used_at: Option<Timestamp>,
    /// Which robot that was.
    pub used_by: Option<RobotId>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
}

/// Asks for a join token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateJoinToken {
    /// The site that the robot joins.
    pub site: SiteId,
    /// The robot that it is for. Without it any robot may join that is new to the site; one that
    /// is known there, or was revoked, must be named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// Minutes until it is refused, 1 to 1440; 60 when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_minutes: Option<u32>,
}

/// A new join token with its secret, which is shown only here.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreatedJoinToken {
    /// The token.
    pub join_token: JoinToken,
    /// What the robot shows.
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

/// A robot joins.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct EnrolRobot {
    /// The secret of a join token.
    pub token: String,
    /// Who it is; may be left out if the token names it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// A PKCS #10 request for its key, PEM. Only the key in it counts: names are the server's.
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

/// A robot asks for its next certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RenewCertificate {
    /// Its present certificate, PEM.
    pub certificate: String,
    /// A PKCS #10 request for its next key, PEM, signed with that key.
    pub certificate_request: String,
    /// The ECDSA P-256 signature of [`renewal_message`] with the present key, ASN.1, base64.
    pub proof: String,
}

/// What a robot gets when it joins, and with each renewal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RobotCertificate {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// How often it has joined, from 1; a certificate of an earlier time is refused.
    pub enrolment: u32,
    /// Its certificate, PEM.
    pub certificate: String,
    /// Whom the robots' port may show to be signed by, PEM: the fleet's authority, and during a
    /// rotation the former one after it.
    pub authority: String,
    /// How long the certificate is good for, seconds from now. Renew it after two thirds of that.
    pub lifetime_s: u64,
    /// From when on it is refused.
    pub expires_at: Timestamp,
    /// The TCP port that robots connect to.
    pub port: u16,
}

/// One time that a robot joined.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Enrolment {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// How often it has joined, from 1.
    pub number: u32,
    /// When it joined.
    pub enrolled_at: Timestamp,
    /// The join token that it came with.
    pub join_token: JoinTokenId,
    /// When it got its present certificate.
    pub renewed_at: Timestamp,
    /// From when on its present certificate is refused.
    pub expires_at: Timestamp,
    /// When it was revoked, or replaced because the robot joined again.
    pub revoked_at: Option<Timestamp>,
    /// Who did that.
    pub revoked_by: Option<String>,
    /// SHA-256 of the authority that signed the certificate which the robot presented last; during
    /// a rotation it shows which robots have moved to the new one. `null` for a robot that has
    /// presented none since this is recorded.
    #[serde(default)]
    pub authority: Option<String>,
}

/// Names the authorities that a robot trusts, so that both sides see whether they mean the same.
/// It is a hint and no proof.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TrustId(u64);

impl TrustId {
    /// The name of a set of certificates, each as DER; their order does not matter.
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

    /// Its bits, which are as good as random.
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

/// The fleet's authority, and how far its rotation is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FleetAuthority {
    /// SHA-256 of the certificate of the authority that signs robots' certificates.
    pub signing: String,
    /// The rotation that is under way.
    pub rotation: Option<AuthorityRotation>,
    /// False while the disk has not confirmed that the former authority is retired. It is, and a power
    /// cut before this is true may undo it; the server tries again by itself.
    pub on_disk: bool,
    /// How many robots must join again: what they showed last was signed by an authority that was retired.
    pub robots_to_join: u32,
    /// The first of them, at most 1000.
    pub to_join: Vec<RobotLeft>,
}

/// A rotation of the fleet's authority: both are trusted, and the new one signs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuthorityRotation {
    /// Its name, which finishing it takes.
    #[schema(value_type = String)]
    pub id: TrustId,
    /// SHA-256 of the certificate of the authority that is to be retired.
    pub retiring: String,
    /// When the rotation was started.
    pub started_at: Timestamp,
    /// Who started it.
    pub started_by: String,
    /// How many robots have shown a certificate of the new authority.
    pub robots_moved: u32,
    /// How many robots have not; once the former authority is retired they must join again.
    pub robots_left: u32,
    /// The first of those that have not, at most 1000.
    pub left: Vec<RobotLeft>,
}

/// A robot that still holds a certificate of an authority that is to be retired, or was.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RobotLeft {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// When it got its certificate.
    pub renewed_at: Timestamp,
    /// Whether its heartbeat arrives at the server now.
    pub online: bool,
}

/// Finishes a rotation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FinishRotation {
    /// Which one: the `id` that its start has answered.
    #[schema(value_type = String)]
    pub rotation: TrustId,
    /// Retire the former authority though robots still hold certificates of it; they must join again.
    #[serde(default)]
    pub force: bool,
}

/// Puts another authority in the place of the present one, at once.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceAuthority {
    /// The `signing` of the authority to replace, so that a client replaces only the one that it
    /// has seen.
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
