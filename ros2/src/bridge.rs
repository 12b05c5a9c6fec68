//! Key expressions of `zenoh-bridge-ros2dds`: robots on DDS, with the bridge beside them.
//!
//! A topic's key is its name below the bridge's own namespace. The payload is the message as DDS
//! has it; there is no type in the key, no attachment, and the bridge looks for readers and writers
//! on DDS alone, so that nobody has to announce himself.

use crate::names::Name;

impl Name {
    /// The key of this topic; `namespace` is that of the bridge, not of the robot's nodes.
    pub fn bridge_key(&self, namespace: &Self) -> String {
        if namespace.as_str().is_empty() {
            self.as_str().to_owned()
        } else {
            format!("{}/{}", namespace.as_str(), self.as_str())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_is_below_the_bridges_namespace() {
        let topic = Name::topic("/cmd_vel", &Name::default()).unwrap();
        let robot = Name::namespace("/robot7").unwrap();
        assert_eq!(topic.bridge_key(&robot), "robot7/cmd_vel");
        assert_eq!(topic.bridge_key(&Name::default()), "cmd_vel");
    }
}
