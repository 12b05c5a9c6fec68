//! Which certificates of a robot count for a renewal: those that this server has signed, and that the
//! robot may have. Whoever has the authority's key can make others, and gets nothing for them.

use serde::{Deserialize, Serialize};

/// Most certificates that count at a time.
const ISSUED_MAX: usize = 16;

/// The fingerprints of the certificates that count, oldest first: the one that the robot showed last for
/// a renewal, and those that were signed since, whose answers may have been lost or come late.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Issued(Vec<String>);

impl Issued {
    /// One certificate alone.
    pub fn one(fingerprint: String) -> Self {
        Self(vec![fingerprint])
    }

    /// What becomes of them when one of them is shown and the next is signed; `None` if the one that is
    /// shown does not count. Whoever shows one has those of before no more.
    #[must_use]
    pub fn renewed(&self, shown: &str, next: String) -> Option<Self> {
        let at = self.0.iter().position(|one| one == shown)?;
        let mut left = self.0[at..].to_vec();
        if left.len() >= ISSUED_MAX {
            // Of those that were signed for the same one, the answer to the oldest comes no more.
            left.remove(1);
        }
        left.push(next);
        Some(Self(left))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_was_not_signed_here_or_long_ago_does_not_count() {
        let issued = Issued::one("a".to_owned());
        assert_eq!(issued.renewed("forged", "b".to_owned()), None);
        let issued = issued.renewed("a", "b".to_owned()).unwrap();
        // The answer was lost, and the robot asks again.
        let issued = issued.renewed("a", "c".to_owned()).unwrap();
        let issued = issued.renewed("b", "d".to_owned()).unwrap();
        assert_eq!(issued.renewed("a", "e".to_owned()), None);
        assert_eq!(issued, Issued(vec!["b".into(), "c".into(), "d".into()]));
    }

    proptest! {
        /// A robot asks, asks again when it has waited for long, and takes the answer to what it asked
        /// last; requests come late and in any order, and answers are lost.
        #[test]
        fn whatever_is_lost_or_late_the_certificate_that_a_robot_has_counts(
            steps in prop::collection::vec((0_u8..3, any::<prop::sample::Index>()), 1..200),
        ) {
            let mut issued = Issued::one("0".to_owned());
            let mut held = "0".to_owned();
            let (mut asked, mut signed) = (0_u32, 0_u32);
            let mut on_the_way: Vec<(u32, String)> = Vec::new();
            let mut answers: Vec<(u32, String)> = Vec::new();
            for (what, which) in steps {
                match what {
                    // More than a few are never under way: robots wait longer and longer.
                    0 if on_the_way.len() + answers.len() < ISSUED_MAX - 2 => {
                        asked += 1;
                        on_the_way.push((asked, held.clone()));
                    }
                    1 if !on_the_way.is_empty() => {
                        let (number, shown) = on_the_way.remove(which.index(on_the_way.len()));
                        signed += 1;
                        if let Some(renewed) = issued.renewed(&shown, signed.to_string()) {
                            issued = renewed;
                            answers.push((number, signed.to_string()));
                        }
                    }
                    2 if !answers.is_empty() => {
                        let (number, certificate) = answers.remove(which.index(answers.len()));
                        if number == asked {
                            held = certificate;
                        }
                    }
                    _ => {}
                }
                prop_assert!(issued.0.contains(&held), "{held} is not in {issued:?}");
                prop_assert!(issued.0.len() <= ISSUED_MAX);
            }
        }
    }
}
