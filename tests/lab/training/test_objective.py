import torch

from carts_core.lab.training.tasks import consistency_loss, soft_dice_loss


def _scene() -> tuple[torch.Tensor, torch.Tensor]:
    """Classes of an image with a shaft and a head, and features that distinguish the three."""
    classes = torch.zeros(1, 32, 32, dtype=torch.uint8)
    classes[:, 10:20, 5:15] = 1
    classes[:, 10:20, 15:20] = 2
    features = torch.nn.functional.one_hot(classes.long(), 3).permute(0, 3, 1, 2).float()
    return classes, features


def test_features_that_tell_the_classes_apart_have_no_consistency_loss():
    classes, features = _scene()
    assert consistency_loss(features, 3 * features, classes, classes) < 0.01


def test_features_that_are_equal_everywhere_lose_where_the_instrument_moved():
    classes, _ = _scene()
    moved = classes.roll(6, dims=2)
    same = torch.ones(1, 3, 32, 32)
    assert consistency_loss(same, same, classes, classes) < 0.01
    assert consistency_loss(same, same, classes, moved) > 0.9


def test_dice_loss_is_zero_for_the_truth_and_near_one_for_its_opposite():
    truth = torch.zeros(2, 16, 16)
    truth[:, :8] = 1
    assert soft_dice_loss(truth, truth) < 1e-6
    assert soft_dice_loss(1 - truth, truth) > 0.98
