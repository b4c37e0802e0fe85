"""What the page of `watch --web --allow-control` may order, and the forms that it orders with.

Read `translate_order.py` first.
"""
