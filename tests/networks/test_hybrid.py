import torch

from carts_core.networks import hybrid


def test_a_hybrid_shows_the_rendering_inside_the_silhouette_and_the_background_outside():
    rendering, background = torch.rand(3, 4, 6), torch.rand(3, 4, 6)
    silhouette = torch.zeros(4, 6)
    silhouette[1:3, 2:5] = 1
    rendering = rendering * silhouette
    image = hybrid(rendering, silhouette, background)
    inside = silhouette.bool()
    torch.testing.assert_close(image[:, inside], rendering[:, inside])
    torch.testing.assert_close(image[:, ~inside], background[:, ~inside])


def test_one_background_serves_a_batch_of_hypotheses():
    assert hybrid(torch.rand(5, 2, 3, 4, 6), torch.rand(5, 2, 4, 6), torch.rand(3, 4, 6)).shape == (5, 2, 3, 4, 6)


def test_a_point_that_moves_outwards_takes_the_backgrounds_place():
    """Where the silhouette grows by a share, so does the rendering, and the background gives way by that share."""
    silhouette = torch.zeros(1, 1, requires_grad=True)
    tool = 0.9 * torch.ones(3, 1, 1)
    hybrid(tool * silhouette, silhouette, torch.full((3, 1, 1), 0.25)).sum().backward()
    assert silhouette.grad is not None
    torch.testing.assert_close(silhouette.grad, torch.full((1, 1), 3 * (0.9 - 0.25)))
