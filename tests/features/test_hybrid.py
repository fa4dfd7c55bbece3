import torch

from carts_core.features import hybrid


def test_a_hybrid_shows_the_rendering_inside_the_silhouette_and_the_background_outside():
    rendering, background = torch.rand(3, 4, 6), torch.rand(3, 4, 6)
    silhouette = torch.zeros(4, 6)
    silhouette[1:3, 2:5] = 1
    image = hybrid(rendering, silhouette, background)
    inside = silhouette.bool()
    torch.testing.assert_close(image[:, inside], rendering[:, inside])
    torch.testing.assert_close(image[:, ~inside], background[:, ~inside])


def test_one_background_serves_a_batch_of_hypotheses():
    assert hybrid(torch.rand(5, 2, 3, 4, 6), torch.rand(5, 2, 4, 6), torch.rand(3, 4, 6)).shape == (5, 2, 3, 4, 6)


def test_the_silhouette_receives_the_contrast_as_gradient():
    silhouette = torch.full((1, 1), 0.5, requires_grad=True)
    hybrid(torch.ones(3, 1, 1), silhouette, torch.full((3, 1, 1), 0.25)).sum().backward()
    assert silhouette.grad is not None
    torch.testing.assert_close(silhouette.grad, torch.full((1, 1), 2.25))
