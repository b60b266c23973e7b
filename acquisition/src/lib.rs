//! From a rig, or from somebody's files, to a run's MCAP file.
