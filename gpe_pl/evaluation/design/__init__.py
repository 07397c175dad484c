"""Design: the pose of an obstacle that guides nodes to a target, found with gradients through rollouts of a model."""
