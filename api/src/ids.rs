//! Identifiers: short readable names for what people name, UUIDs for what programs create.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

/// Maximum length of a readable identifier, bytes. An identifier is one chunk of a key expression.
pub const SLUG_LENGTH_MAX: usize = 63;

/// Error for a text that is not a readable identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not an identifier: use 1 to {SLUG_LENGTH_MAX} characters out of a-z, 0-9 and `-`"
)]
pub struct InvalidSlug {
    text: String,
}

fn check_slug(text: &str) -> Result<(), InvalidSlug> {
    let allowed = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
    if !text.is_empty() && text.len() <= SLUG_LENGTH_MAX && text.bytes().all(allowed) {
        Ok(())
    } else {
        // The text may come from the network, so only a bounded part of it is kept for the message.
        let text = text.chars().take(SLUG_LENGTH_MAX + 1).collect();
        Err(InvalidSlug { text })
    }
}

macro_rules! slug {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
        )]
        #[serde(try_from = "String", into = "String")]
        #[schema(value_type = String, pattern = "^[a-z0-9-]{1,63}$", example = "north-yard")]
        pub struct $name(String);

        impl $name {
            /// Returns the identifier as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = InvalidSlug;

            fn from_str(text: &str) -> Result<Self, InvalidSlug> {
                check_slug(text)?;
                Ok(Self(text.to_owned()))
            }
        }

        impl TryFrom<String> for $name {
            type Error = InvalidSlug;

            fn try_from(text: String) -> Result<Self, InvalidSlug> {
                check_slug(&text)?;
                Ok(Self(text))
            }
        }

        impl From<$name> for String {
            fn from(id: $name) -> Self {
                id.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str(&self.0)
            }
        }
    };
}

slug! {
    /// Identifier of a site: one metric frame with its robots, terrains, cells and missions.
    SiteId
}
slug! {
    /// Identifier of a robot, unique within its site.
    RobotId
}
slug! {
    /// Identifier of a terrain, unique within its site.
    TerrainId
}

slug! {
    /// Identifier of an external program that limits a robot, such as obstacle detection.
    OwnerId
}

slug! {
    /// Tag of a robot, by which people group a fleet.
    Tag
}

slug! {
    /// Kind of an alert, for programs; the same kind always has the same code.
    AlertCode
}

macro_rules! uuid_id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
            ToSchema,
        )]
        #[serde(transparent)]
        #[schema(value_type = Uuid)]
        pub struct $name(Uuid);

        impl $name {
            /// Wraps an existing UUID.
            pub const fn from_uuid(uuid: Uuid) -> Self {
                Self(uuid)
            }

            /// Returns the underlying UUID.
            pub const fn as_uuid(&self) -> Uuid {
                self.0
            }
        }

        impl From<Uuid> for $name {
            fn from(uuid: Uuid) -> Self {
                Self(uuid)
            }
        }

        impl FromStr for $name {
            type Err = uuid::Error;

            fn from_str(text: &str) -> Result<Self, uuid::Error> {
                Uuid::parse_str(text).map(Self)
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(formatter)
            }
        }
    };
}

uuid_id! {
    /// Identifier of a mission: a version 7 UUID, so that identifiers sort by creation.
    MissionId
}
uuid_id! {
    /// Identifier of an alert: a version 7 UUID, so that identifiers sort by time.
    AlertId
}
uuid_id! {
    /// Identifier of a token of a person or program: a version 7 UUID; not secret.
    TokenId
}
uuid_id! {
    /// Identifier of a join token, with which a robot joins the fleet: a version 7 UUID; not
    /// secret.
    JoinTokenId
}
uuid_id! {
    /// Identifier of a webhook: a version 7 UUID.
    WebhookId
}
uuid_id! {
    /// Identifier of a delivery to a webhook: a version 7 UUID, so that identifiers sort by time.
    DeliveryId
}
uuid_id! {
    /// Identifier of a browser's session: a version 7 UUID; not secret.
    SessionId
}
uuid_id! {
    /// Identifier of a person who signs in at an OpenID provider: the version 5 UUID of the
    /// provider's issuer and the person's subject there. It does not depend on any other claim of
    /// the provider.
    PersonId
}
uuid_id! {
    /// Identifier of a stop: a version 7 UUID, so that identifiers sort by time.
    StopId
}
uuid_id! {
    /// Identifier of one run of an agent's process: a new version 4 UUID at each start.
    BootId
}
uuid_id! {
    /// Identifier of a configuration, a robot's model and tyres: the version 5 UUID of their
    /// description.
    ///
    /// Equal descriptions have equal identifiers on every machine, and a change of tyres changes
    /// the identifier, so that friction measured with different tyres is never combined. See
    /// [`crate::robot::RobotModel::configuration`].
    ConfigurationId
}
uuid_id! {
    /// Hash of exactly what a robot is requested to drive: the version 5 UUID of mission, revision
    /// and trajectory.
    ///
    /// See [`crate::wire::command::Offer::plan_hash_of`].
    PlanHash
}

/// Identity of a person at an OpenID provider: its issuer, and the subject there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OidcSubject<'text> {
    /// The provider's issuer.
    pub issuer: &'text str,
    /// The subject at that provider.
    pub subject: &'text str,
}

impl PersonId {
    /// Returns the identifier of the person with this subject at the provider with this issuer.
    pub fn of(OidcSubject { issuer, subject }: OidcSubject<'_>) -> Self {
        // The length makes the name of every pair of issuer and subject unique.
        let name = format!("person {} {issuer} {subject}", issuer.len());
        Self(Uuid::new_v5(&DERIVED_NAMESPACE, name.as_bytes()))
    }
}

/// Name space of all version 5 UUIDs of this crate. A change of it would change every derived
/// identifier.
pub(crate) const DERIVED_NAMESPACE: Uuid =
    Uuid::from_u128(0x8f1d_5d53_6a0e_4f0b_9d3c_2f7a_51c4_e6b0);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identifier_is_one_chunk_of_a_key_expression() {
        assert!("rover-1".parse::<RobotId>().is_ok());
        let too_long = "a".repeat(SLUG_LENGTH_MAX + 1);
        for bad in [
            "",
            "Rover",
            "a/b",
            "a*",
            "a b",
            "$x",
            "ü",
            too_long.as_str(),
        ] {
            assert!(bad.parse::<RobotId>().is_err(), "`{bad}` was taken");
        }
    }

    #[test]
    fn a_person_is_an_issuer_and_a_subject_there() {
        let person = |issuer, subject| PersonId::of(OidcSubject { issuer, subject });
        let anna = person("https://login.test", "anna");
        assert_eq!(anna, person("https://login.test", "anna"));
        for (issuer, subject) in [
            ("https://login.test", "bert"),
            ("https://login.test/", "anna"),
            ("https://login.test anna", ""),
            ("https://login.tes", "t anna"),
        ] {
            assert_ne!(anna, person(issuer, subject), "{issuer} {subject}");
        }
    }

    #[test]
    fn a_bad_identifier_is_refused_while_parsing_json() {
        let error = serde_json::from_str::<SiteId>("\"A B\"").unwrap_err();
        assert!(
            error.to_string().contains("`A B` is not an identifier"),
            "{error}"
        );
    }
}
